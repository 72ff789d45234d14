"""A finished run in the files of other programs: one function writes the chosen formats.

Display colours are baked once. Their baking error is measured and written beside each file.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path, PurePosixPath

import numpy as np

from p2gs_jax.core.atomic import atomic_folder, write_json
from p2gs_jax.core.numerics import evenly_spaced
from p2gs_jax.core.progress import Reporter
from p2gs_jax.core.text import stems
from p2gs_jax.errors import UserError
from p2gs_jax.export.folders import Program, write_folder
from p2gs_jax.export.page import MEGABYTE, write_page
from p2gs_jax.export.sidecar import corrections_name, linear_sidecar
from p2gs_jax.formats import gsply_files as gsply
from p2gs_jax.formats.exr import write_exr
from p2gs_jax.formats.gltf import write_gltf
from p2gs_jax.formats.ply import write_ply, write_radiance
from p2gs_jax.formats.usd import require_pxr, write_usd
from p2gs_jax.gaussians import bake as baking
from p2gs_jax.photometry.display import DisplayTransform
from p2gs_jax.render.capacity import make_renderer
from p2gs_jax.render.project import at_time
from p2gs_jax.run.folder import require_folder
from p2gs_jax.run.photometry_files import write_appearance
from p2gs_jax.run.read import Run
from p2gs_jax.scene.convert.readers import read_exif_settings
from p2gs_jax.scene.pixels.store import camera_of
from p2gs_jax.types import Gaussians

# The files or folders that each format writes.
PLACES: dict[str, tuple[str, ...]] = {
    "linear-ply": ("linear.ply", "linear.json"),
    "display-ply": ("display.ply", "display.ply.json"),
    "spz": ("display.spz", "display.spz.json"),
    "compressed-ply": ("display.compressed.ply", "display.compressed.ply.json"),
    "gltf": ("display.glb", "display.glb.json"),
    "usd": ("display.usdc", "display.usdc.json"),
    "colmap": ("colmap",),
    "nerfstudio": ("nerfstudio",),
    "exr": ("exr",),
    "html": ("scene.html",),
}
STEPS = 240  # least number of baking steps by default
# The baking error is measured on at most this many views of each split, evenly spread.
MEASURED = 60
# Least median PSNR called close, dB: two scenes had 31 to 38 dB, without refinement 19 to 22 dB.
CLOSE_DB = 30.0
# The writer of each format with display colours, and its reader if the format rounds values.
WRITERS: dict[str, tuple[Callable, Callable | None]] = {
    "spz": (gsply.write_spz, gsply.read_spz),
    "compressed-ply": (gsply.write_compressed_ply, gsply.read_compressed_ply),
    "gltf": (write_gltf, None),
    "display-ply": (write_ply, None),
    "usd": (write_usd, None),
}


def require_packages(formats: Sequence[str]) -> None:
    """Raise UserError if a format needs a package that is not installed."""
    if {"spz", "compressed-ply"} & set(formats):
        gsply.require_gsply()
    if "usd" in formats:
        require_pxr()


def convert(
    fitted: Run,
    formats: Sequence[str],
    folder: Path,
    transform: DisplayTransform,
    *,
    bake_steps: int | None,
    page_mb: float,
    page_photographs: int,
    overwrite: bool,
    reporter: Reporter,
) -> Iterator[tuple[Path, str, float]]:
    """Write a run in every format; yield each path, a sentence about it, and the seconds it took.

    `transform` makes display colours, which `bake_steps` steps refine (None: a default). The page
    has at most `page_mb` million bytes and `page_photographs` photographs. Raises UserError: a file
    exists without `overwrite`, or a photograph that a format needs is missing.
    """
    _check_places(folder, [folder / place for name in formats for place in PLACES[name]], overwrite)
    if {"colmap", "nerfstudio", "exr"} & set(formats):
        _check_names(fitted)
    if {"colmap", "nerfstudio"} & set(formats):
        fitted.require_photographs()
    transform, display = transform.without_place(), None
    for name in formats:
        begin, place = time.monotonic(), folder / PLACES[name][0]
        if name == "linear-ply":
            text = _linear_ply(place, fitted)
        elif name in ("colmap", "nerfstudio"):
            text = _other_trainer(name, place, fitted, reporter)
        elif name == "exr":
            text = _exr(place, fitted, reporter)
        elif name == "html":
            shown, count = fitted.over_black(), page_photographs
            page = write_page(
                place, shown, transform, size_mb=page_mb, photographs=count, say=reporter.stage
            )
            text = " ".join([f"{page.size / MEGABYTE:.1f} MB.", *page.sentences])
        else:
            if display is None:
                display = DisplayFiles(fitted.over_black(), transform, bake_steps, reporter)
            text = display.write(name, place, folder / PLACES[name][1])
        yield place, text, time.monotonic() - begin


def _check_places(folder: Path, places: Sequence[Path], overwrite: bool) -> None:
    require_folder(folder)
    existing = [path for path in places if path.exists()]
    if existing and not overwrite:
        fix = "add --overwrite to replace it, or name another folder with --out"
        raise UserError(f"{existing[0]} already exists.", fix=fix)


def _check_names(fitted: Run) -> None:
    """Raise UserError if the name of a view leads out of the folder of exported files."""
    for view in fitted.scene.views:
        name = PurePosixPath(view.name)
        if name.is_absolute() or ".." in name.parts:
            fix = "move its photograph into the image folder and fit again"
            raise UserError(f"the view {view.name} lies outside the image folder.", fix=fix)


def _linear_ply(ply: Path, fitted: Run) -> str:
    g, kind = at_time(fitted.as_of(), None), fitted.cfg.photometry.appearance
    sidecar = ply.with_suffix(".json")
    write_radiance(ply, g, activation=fitted.cfg.render.radiance)
    content = linear_sidecar(g, fitted.cfg, fitted.scene, fitted.store, fitted.photometry)
    if fitted.lifting_error is not None:
        content["lifting_error"] = fitted.lifting_error
    write_json(sidecar, content)
    if kind is not None:
        views = fitted.scene.training_views
        write_appearance(ply.parent / corrections_name(kind), fitted.params.appearance, views)
    return f"{g.capacity} Gaussians of linear radiance; {sidecar.name} describes their fields"


def _other_trainer(name: Program, place: Path, fitted: Run, reporter: Reporter) -> str:
    on_view = functools.partial(reporter.stage, "Writing photographs")
    photometry = fitted.photometry["views"]
    write_folder(name, place, fitted.scene, fitted.store, photometry, on_view=on_view)
    views = f"{len(fitted.scene.views)} views"
    if name == "colmap":
        return f"{views}, {len(fitted.scene.points)} points, exposures.csv"
    return f"{views} for `ns-train splatfacto --data`"


def _exr(place: Path, fitted: Run, reporter: Reporter) -> str:
    views = fitted.scene.views
    with atomic_folder(place) as temporary:
        for index, stem in enumerate(stems([view.name for view in views])):
            camera = camera_of(fitted.store, index)
            result, path = fitted.render(camera), temporary / f"{stem}.exr"
            linear, depth, alpha = map(np.asarray, (result.linear, result.depth, result.alpha))
            write = functools.partial(write_exr, depth=depth, alpha=alpha, camera=camera)
            shot = read_exif_settings(views[index].image_path)
            write(path, linear, transform=fitted.own_display(index), shot=shot)
            reporter.stage("Rendering", index + 1, len(views))
    return f"{len(views)} linear renders"


class DisplayFiles:
    """Display colours under one display transform, baked once, with their error."""

    def __init__(
        self, fitted: Run, transform: DisplayTransform, steps: int | None, reporter: Reporter
    ):
        """Render the true pictures, bake, and refine in `steps` steps (None: a default)."""
        self.fitted, self.transform, self.reporter = fitted, transform, reporter
        scene, cfg = fitted.scene, fitted.cfg
        g = at_time(fitted.as_of(), None)
        self.steps = max(STEPS, len(scene.train_indices)) if steps is None else steps
        render = make_renderer(cfg.render)
        self.targets: dict[int, baking.Target] = {}
        wanted = scene.train_indices if self.steps else _spread(scene.train_indices)
        rows = [*wanted, *_spread(scene.test_indices)]
        for done, index in enumerate(rows):
            name, camera = scene.views[index].name, camera_of(fitted.store, index)
            self.targets[index] = baking.target(name, g, camera, render, transform)
            reporter.stage("Rendering true pictures", done + 1, len(rows))
        reporter.stage("Baking")
        start = baking.bake(g, transform, cfg.render.radiance)
        aims = [self.targets[i] for i in scene.train_indices if i in self.targets]
        steps, seed = self.steps, cfg.train.seed
        on_step = functools.partial(reporter.stage, "Baking")
        self.baked = baking.refine(start, aims, cfg.render, steps=steps, seed=seed, on_step=on_step)

    def write(self, name: str, path: Path, sidecar: Path) -> str:
        """Write the format `name`, and its baking error as JSON; return a sentence on it."""
        begin, more = time.monotonic(), ()
        write, read = WRITERS[name]
        error = self.error if read is None else {}
        if name == "display-ply":
            note = f"p2gs-jax: {_sentence(error)}"
            more = ([*baking.display_comments(self.transform), note],)
        elif name == "usd":
            views, store = self.fitted.scene.views, self.fitted.store
            more = ({view.name: camera_of(store, index) for index, view in enumerate(views)},)
        write(path, self.baked, *more)
        if read is not None:
            error = self._error(read(path))
        mean, balance = self.fitted.mean.exposure_geometric, self.transform.white_balance
        write_json(
            sidecar,
            {
                "file": path.name,
                "gaussians": self.baked.capacity,
                "exposure": self.transform.exposure,
                "exposure_ev_from_mean": float(np.log2(self.transform.exposure / mean)),
                "gamma": self.transform.gamma,
                "curve": self.transform.formation.curve,
                "white_balance": None if balance is None else np.exp(balance).tolist(),
                "bake_steps": self.steps,
                "seconds": time.monotonic() - begin,
                "baking_error": error,
            },
        )
        return f"{self.baked.capacity} Gaussians; {_sentence(error)}"

    @functools.cached_property
    def error(self) -> dict:
        """The baking error by split."""
        return self._error(self.baked)

    def _error(self, gaussians: Gaussians) -> dict:
        self.reporter.stage("Measuring")
        scene, render = self.fitted.scene, self.fitted.cfg.render
        splits = {"train": scene.train_indices, "test": scene.test_indices}
        aims = {split: [self.targets[i] for i in _spread(rows)] for split, rows in splits.items()}
        return {split: baking.baking_error(gaussians, aim, render) for split, aim in aims.items()}


def _spread(rows: Sequence[int]) -> list[int]:
    return [rows[i] for i in evenly_spaced(len(rows), MEASURED)]


def _sentence(error: dict) -> str:
    """Return a sentence on the baking error by split, and whether it is small."""
    splits = (("training", error["train"]), ("held-out", error["test"]))
    found = [(e["psnr_median"], e["views"], name) for name, e in splits if e is not None]
    far = "visibly different from the true ones (below"
    how = "close to the true ones (at least" if min(found)[0] >= CLOSE_DB else far
    medians = ", ".join(f"median {db:.2f} dB over {n} {name} views" for db, n, name in found)
    return f"viewers show pictures {how} {CLOSE_DB:.0f} dB): {medians}"
