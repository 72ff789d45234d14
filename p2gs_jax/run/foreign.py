"""Splats of another program as a run, shown with the exposures of the original photographs.

Its Gaussians have display colours, trained on photographs that `calibrate --develop` wrote at one
exposure. `photometry.json` of the same folder has the exposure of every original photograph.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from p2gs_jax.config import DataConfig, FitConfig, PhotometryConfig, RenderConfig
from p2gs_jax.core.atomic import readable
from p2gs_jax.core.numerics import evenly_spaced, on_device
from p2gs_jax.core.text import count_of, first_few, read_csv
from p2gs_jax.errors import UserError, broken
from p2gs_jax.formats.splats import read_splats
from p2gs_jax.gaussians import bake
from p2gs_jax.photometry.display import DisplayTransform, light_of
from p2gs_jax.photometry.formation import LEAST_ALPHA
from p2gs_jax.photometry.metering import Metering
from p2gs_jax.render.capacity import RenderView, make_renderer
from p2gs_jax.run import photometry_files, read
from p2gs_jax.run.scene_file import folder_of
from p2gs_jax.scene import find_scene, with_masks_and_split
from p2gs_jax.scene.convert.convert import converted_views
from p2gs_jax.scene.exposures import row_finder
from p2gs_jax.scene.masks import with_alpha
from p2gs_jax.scene.pixels.store import camera_of
from p2gs_jax.types import GAMMA_SRGB, Gaussians, Params, Scene

# The table of `calibrate --develop` beside the photographs that it wrote: `ev` is their exposure.
DEVELOPED = Path("developed") / "exposures.csv"
AGAIN = "repeat `p2gs-jax calibrate ... --develop`"
# Lifted Gaussians are compared in at most `MEASURED` views, at most `MEASURED_WIDTH` pixels wide.
# `NEAR` is the depth of other programs' near plane, scene units.
MEASURED, MEASURED_WIDTH, NEAR = 60, 960, 0.01


@dataclass(frozen=True)
class ForeignRun(read.Run):
    """Splats of another program. `params.gaussians` are lifted to radiance, and approximate them.

    `render` composites display colours as their program did, and returns the radiance that the
    picture shows.
    """

    _: KW_ONLY
    splats: Gaussians  # with display colours, max(0, sh + 1/2)
    developed: DisplayTransform  # the look of the photographs that they were trained on

    @cached_property
    def metering(self) -> Metering:
        """Raise a UserError: no training exposures are known to splats."""
        fix = "leave out --meter, or give an exposure with --exposure-ev"
        raise UserError("--meter needs a run, and splats are not a run.", fix=fix)

    @cached_property
    def _renderer(self) -> RenderView:
        render = make_renderer(bake.viewer_config(self.cfg.render))

        def shown(_, alive, camera):
            result, share = render(self.splats, alive, camera), 1.0
            if self.store.backdrop is not None:
                share = np.maximum(np.asarray(result.alpha), LEAST_ALPHA)[..., None]
            light = light_of(np.asarray(result.linear) / share, self.developed)
            return replace(result, linear=share * light)

        return shown

    def refined(
        self, steps: int, on_step: Callable[[int, int], None] = lambda done, steps: None
    ) -> ForeignRun:
        """Return the run with lifted Gaussians that are closer to the other program's pictures.

        These pictures show display colours. The run has the error; `refine` gets `on_step`.
        """
        cfg, developed, targets = self.cfg.render, self.developed, []
        render = make_renderer(bake.viewer_config(cfg))
        for row in evenly_spaced(len(self.scene.views), MEASURED):
            view = self.scene.views[row]
            camera = camera_of(self.store, row, max(view.width / MEASURED_WIDTH, 1.0))
            targets.append(bake.target(view.name, self.splats, camera, render))
        lifted = self.params.gaussians
        lifted = bake.refine(lifted, targets, cfg, steps=steps, shown=developed, on_step=on_step)
        e: Any = bake.baking_error(lifted, targets, cfg, developed)
        note = (
            f"Lifted to radiance, the Gaussians match {count_of(e['views'], 'picture')} of their "
            f"program with a median PSNR of {e['psnr_median']:.2f} dB: radiance is composited "
            "instead of display values."
        )
        params = replace(self.params, gaussians=lifted)
        return replace(self, params=params, lifting_error=e, notes=(*self.notes, note))


def load_run_or_splats(run: Path, scene: Path | None, photometry: Path | None) -> read.Run:
    """Return a finished run, or with `photometry` the splats of another program (`foreign_run`).

    UserError: see `load_run` and `foreign_run`; or splats come without a scene.
    """
    if photometry is None:
        return read.load_run(run, scene)
    if scene is None:
        fix = "add --scene SCENE, the scene that was calibrated"
        raise UserError("--photometry needs the cameras of a scene.", fix=fix)
    return foreign_run(run, photometry, scene)


def foreign_run(splats: str | Path, photometry: str | Path, scene: str | Path) -> ForeignRun:
    """Return splats of another program as a run, with the photometry of a calibration.

    `photometry` is the folder that `calibrate --develop` wrote, and `scene` the scene that was
    calibrated. Splats must be in the coordinates of the scene. Views without a known exposure have
    the mean, as held-out views. Raises UserError: a file is missing or broken, or the calibration
    is of another scene.
    """
    splats, folder, data = Path(splats), Path(photometry), DataConfig(test_every=0)
    path = folder / "photometry.json"
    if not path.is_file():
        fix = "name the folder that `p2gs-jax calibrate --develop` wrote"
        raise broken(folder, "has no photometry.json", fix)
    saved, found = photometry_files.read_photometry(path), find_scene(Path(scene), data)
    if not isinstance(found, Scene):
        fix = f"name the scene that the other program read, {DEVELOPED.parent} in {folder}"
        raise broken(scene, "has no COLMAP model and no transforms.json", fix)
    found = with_masks_and_split(found, data)
    found = with_alpha(converted_views(found, folder / "cache", lambda text: None), data)
    if folder_of(found.root).resolve() == (folder / DEVELOPED).parent.resolve():
        saved = _with_developed_names(saved, folder, found)
    found, notes = _with_known(found, saved, path)
    gaussians = read_splats(splats)
    means = on_device(np.asarray(gaussians.means, np.float64) - np.array(found.origin))
    gaussians, developed = replace(gaussians, means=means), common_look(folder, saved)
    render = RenderConfig(blur=bake.VIEWER_BLUR, near=NEAR)
    cfg = FitConfig(photometry=developed.formation, render=render)
    return ForeignRun(
        splats.with_suffix(""),
        Params(bake.lift(gaussians, developed), read.photometry_of(saved, found, cfg, path)),
        cfg,
        found,
        None,
        saved,
        notes=notes,
        splats=gaussians,
        developed=developed,
    )


def _with_developed_names(
    saved: photometry_files.PhotometryFile, folder: Path, scene: Scene
) -> photometry_files.PhotometryFile:
    """Return the photometry of a calibration by the names of its developed photographs."""
    row_of = row_finder(scene.views, folder / DEVELOPED)
    with readable(folder / DEVELOPED, AGAIN):
        rows = [row_of(row["image"]) for row in _developed(folder)]
        named = list(zip(saved["views"], rows, strict=True))
    views = [v | {"image": scene.views[row].name} for v, row in named if row is not None]
    return {**saved, "views": views}  # pyright: ignore[reportReturnType]


def _developed(folder: Path) -> list[dict[str, str]]:
    """Return the rows of the table of developed photographs, in the order of `photometry.json`."""
    with readable(folder / DEVELOPED, AGAIN):
        lines = (folder / DEVELOPED).read_text(encoding="utf-8").splitlines()
        return [row for _, row in read_csv(folder / DEVELOPED, lines)[1]]


def _with_known(
    scene: Scene, saved: photometry_files.PhotometryFile, path: Path
) -> tuple[Scene, tuple[str, ...]]:
    """Return the scene with views of unknown exposure held out, and notes on them."""
    known = {view["image"] for view in saved["views"] if view["exposure"] is not None}
    views = [replace(v, split="train" if v.name in known else "test") for v in scene.views]
    unknown = [view.name for view in views if view.split == "test"]
    if len(unknown) == len(views):
        why = f"{path} has none of the photographs of {scene.root} (for example {unknown[0]})."
        fix = "name the folder that `p2gs-jax calibrate` wrote for this scene"
        raise UserError(why, fix=fix)
    few = f"{count_of(len(unknown), 'view')} of unknown exposure ({first_few(unknown)})"
    notes = (f"The mean exposure is used for {few}.",) if unknown else ()
    return replace(scene, views=tuple(views)), notes


def common_look(folder: Path, saved: photometry_files.PhotometryFile) -> DisplayTransform:
    """Return the look of the developed photographs of a calibration's folder.

    If there are none, it is the mean exposure and gamma of its `photometry.json`. UserError: their
    table cannot be read, or another calibration developed them.
    """
    mean, path = saved["mean"], folder / DEVELOPED
    cfg = photometry_files.with_formation_of(PhotometryConfig(), saved)
    common = DisplayTransform(mean["exposure_geometric"], mean["gamma"], cfg)
    if path.is_file():
        rows = _developed(folder)
        with readable(path, AGAIN):
            row, exposures = rows[0], [view["exposure"] for view in saved["views"]]
            known = [(r["original_ev"], e) for r, e in zip(rows, exposures, strict=True) if e]
            common = replace(common, exposure=2.0 ** float(row["ev"]))
            same = np.allclose([2.0 ** float(ev) for ev, _ in known], [e for _, e in known], 1e-3)
            if row["image"].lower().endswith(".exr"):
                common = replace(common.with_curve("linear"), gamma=GAMMA_SRGB)
        if not same:
            raise broken(path, "and photometry.json are of different calibrations", AGAIN)
    return common
