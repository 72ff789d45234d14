"""Reading a finished run."""

from __future__ import annotations

import contextlib
import difflib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Array, Bool, Float32, Int, UInt8

from p2gs_jax.config import FitConfig
from p2gs_jax.core.atomic import readable
from p2gs_jax.core.numerics import on_device
from p2gs_jax.core.text import parse_json
from p2gs_jax.errors import UserError
from p2gs_jax.formats.frames import notebook_html, to_uint8
from p2gs_jax.formats.ply import read_ply
from p2gs_jax.gaussians.posed import chosen, in_world, standing
from p2gs_jax.photometry import display
from p2gs_jax.photometry.formation import camera_rows
from p2gs_jax.photometry.metering import ExposureOf, Metering, meter
from p2gs_jax.presets import from_dict
from p2gs_jax.render.capacity import RenderView, make_renderer
from p2gs_jax.run import photometry_files
from p2gs_jax.run.decisions import read_decisions
from p2gs_jax.run.folder import RunFolder, find
from p2gs_jax.run.scene_file import read_objects, read_scene
from p2gs_jax.scene.drives.objects import MovingObjects
from p2gs_jax.scene.files import recognition_key
from p2gs_jax.scene.pixels.store import ImageStore, camera_of
from p2gs_jax.types import GAMMA_SRGB, Camera, Gaussians, Params, Photometry, Render, Scene

CONFIG_AGAIN = (
    "restore it from a copy; or remove it and repeat the `p2gs-jax fit` that made it, with "
    "--resume, which writes it again and continues from the last checkpoint"
)


@dataclass(frozen=True)
class Run:
    """A finished run."""

    folder: Path
    params: Params  # the fit
    # options of the fit: those of the user with decisions filled in
    cfg: FitConfig
    scene: Scene  # the fitted scene; its photographs may be missing
    reference: Path | None  # photographs under one common exposure, or None
    # content of `photometry.json`, also standard errors, EXIF, and exposures fitted to held-out
    # photographs
    photometry: photometry_files.PhotometryFile
    # moving object of each Gaussian, -1: none; None: nothing moves
    owner: Int[np.ndarray, " n"] | None = None
    moving: MovingObjects | None = None
    notes: tuple[str, ...] = ()  # notes for the user on what was read
    # error of Gaussians that were lifted from display colours (run/foreign.py), or None
    lifting_error: dict[str, Any] | None = None

    @cached_property
    def store(self) -> ImageStore:
        """The photographs, and the cameras at the size of the fit."""
        return ImageStore(self.scene.views, self.cfg.data, moving=self.moving)

    @cached_property
    def _renderer(self) -> RenderView:
        return make_renderer(self.cfg.render, self.owner)

    def camera(self, index: int) -> Camera:
        """Return the camera of a row of `scene.views` at the size of the fit.

        It has the poses of the moving objects, if there are any.
        """
        return camera_of(self.store, index)

    def render(self, camera: Camera, time: float | None = None) -> Render:
        """Return linear radiance, opacity and depth of a camera.

        Moving objects are rendered at their poses at `time`, seconds; None: at those of the camera.
        A new camera (`make_camera`) has no poses and shows no moving objects.
        """
        if time is not None and self.moving is not None:
            placement = self.moving.placement(np.asarray(camera.viewmat), time)
            camera = replace(camera, objects=placement)
        return self._renderer(self.params.gaussians, self.alive, camera)

    def picture(
        self, view: int | Camera, exposure_ev: float | None = None
    ) -> UInt8[np.ndarray, "h w 3"]:
        """Return a rendered picture that `matplotlib.pyplot.imshow` shows as it is.

        `view` is a row of `scene.views`, rendered as its photograph was taken, or any camera. With
        `exposure_ev`, in stops from the mean exposure, the display is common to all views.
        """
        shown = self.common_display(exposure_ev or 0.0)
        if not isinstance(view, Camera):
            shown = self.own_display(view) if exposure_ev is None else shown
            view = self.camera(view)
        rendered = self.render(view)
        return to_uint8(display.develop(rendered.linear, shown, alpha=rendered.alpha))

    def _repr_html_(self) -> str:
        """Return the main numbers and `summary.png`, for notebooks."""
        files, scene = RunFolder(self.folder), self.scene
        stops = np.log2(np.asarray(self.params.photometry.exposures) / self.mean.exposure_geometric)
        rows: dict[str, object] = {
            "run": files.root,
            "views": f"{len(scene.train_indices)} trained, {len(scene.test_indices)} held out",
            "Gaussians": f"{self.params.gaussians.capacity:,}",
            "exposures": f"{stops.min():+.2f} to {stops.max():+.2f} EV from the mean",
        }
        with contextlib.suppress(OSError, ValueError, KeyError):  # a run without held-out scores
            metrics = parse_json(files.metrics.read_text(encoding="utf-8"))
            psnr = metrics["test"]["exposure_fitted"]["psnr"]
            rows["held-out views"] = f"{psnr:.2f} dB (exposures fitted)"
        return notebook_html(rows, files.summary)

    def without_objects(self) -> Run:
        """Return the run without moving objects and vibrating Gaussians; UserError: has neither."""
        if self.params.gaussians.vibration is None:
            self._require_objects()
        return self._of(standing(self.params.gaussians, self.owner), None)

    def over_black(self) -> Run:
        """Return the run without the radiance behind its splats."""
        render = replace(self.cfg.render, background=None)
        return replace(self, cfg=replace(self.cfg, render=render))

    def only_objects(self) -> Run:
        """Return the run with moving objects only; UserError: there are none."""
        owner = self._require_objects()
        return self._of(chosen(self.params.gaussians, owner >= 0), owner[owner >= 0])

    def _require_objects(self) -> Int[np.ndarray, " n"]:
        if self.owner is None:
            fix = "leave the option out; drives with boxes have moving objects if they are fitted "
            fix += "with --dynamics.method rigid"
            raise UserError(f"{self.folder} has no moving object with Gaussians.", fix=fix)
        return self.owner

    def _of(self, gaussians: Gaussians, owner: Int[np.ndarray, " n"] | None) -> Run:
        return replace(self, params=replace(self.params, gaussians=gaussians), owner=owner)

    def as_of(self) -> Gaussians:
        """Return all Gaussians in world coordinates, moving objects in the middle of the drive."""
        return in_world(self.params.gaussians, self.owner, self.moving, self.scene)

    def photograph(self, index: int) -> Float32[np.ndarray, "h w 3"]:
        """Return the photograph of a row of `scene.views` at the size of the fit, display values.

        UserError: the photograph is missing or broken.
        """
        return self.store.get(index)[0]

    def require_photographs(self, indices: Sequence[int] | None = None) -> None:
        """Raise UserError if photographs of these rows of `scene.views` are missing; None: all."""
        rows = range(len(self.scene.views)) if indices is None else indices
        lost = [p for p in (self.scene.views[i].image_path for i in rows) if not p.is_file()]
        if not lost:
            return
        fault = (
            f"{lost[0]} is missing" + (f", and {len(lost) - 1} more" if len(lost) > 1 else "")
            if self.scene.root.exists()
            else f"the scene of this run, {self.scene.root}, does not exist"
        )
        fix = "put them back, or name the folder of the scene (--scene of view, render, export, "
        fix += "eval and report; in Python load_run(folder, scene))"
        raise UserError(f"this needs the photographs of the run: {fault}.", fix=fix)

    @property
    def alive(self) -> Bool[Array, " n"]:
        """True for all Gaussians: a finished run has no empty slots."""
        return self.params.gaussians.all_alive

    @property
    def mean(self) -> display.MeanParameters:
        """Exposure and gamma of a view that was not fitted."""
        return display.mean_parameters(self.params.photometry)

    def own_display(self, index: int) -> display.DisplayTransform:
        """Return the display transform of the photograph in a row of `scene.views`.

        The exposure of a held-out view is that fitted to its photograph; its other parameters are
        the usual ones of its camera.
        """
        index = range(len(self.scene.views))[index]  # negative ones count from the end
        if index in self.scene.train_indices:
            row = self.scene.train_indices.index(index)
            trained = display.display_of_view(self.params, row, self.cfg.photometry)
            return replace(trained, backdrop=self.store.backdrop_values)
        view = self.scene.views[index]
        usual = self._usual(view.camera)
        fitted = {v["image"]: v["exposure_fitted"] for v in self.photometry["views"]}.get(view.name)
        return usual if fitted is None else replace(usual, exposure=fitted)

    def common_display(self, exposure_ev: float = 0.0) -> display.DisplayTransform:
        """Return one display transform for all views, without a camera and without vignetting.

        Its exposure is in stops from the geometric mean of the training views' exposures.
        """
        usual = self._usual(None)
        return replace(usual, exposure=usual.exposure * 2**exposure_ev)

    def white_balance_of(self, name: str) -> tuple[float, float, float]:
        """Return the log factors of a view's white balance, by its name in the scene.

        UserError: there is no such view, or white balance is not modelled.
        """
        names = [view.name for view in self.scene.views]
        if name not in names:
            near = difflib.get_close_matches(name, names, 1) or names[:1]
            fix = f"give a name of photometry.json, for example {near[0]}"
            raise UserError(f"the run has no view {name!r}.", fix=fix)
        balance = self.own_display(names.index(name)).white_balance
        if balance is None:
            why = "this run models no white balance: it is the same in all photographs."
            raise UserError(why, fix="leave --white-balance-of out")
        return balance

    def _usual(self, camera: str | None) -> display.DisplayTransform:
        cameras = [view.camera for view in self.scene.training_views]
        usual = display.usual_display(self.params, cameras, camera, self.cfg.photometry)
        return replace(usual, backdrop=self.store.backdrop_values)

    @cached_property
    def metering(self) -> Metering:
        """The rule that explains the training exposures."""
        return photometry_files.read_metering(RunFolder(self.folder).metering)

    def metered_display(
        self, rendered: Render, of: ExposureOf = "auto", exposure_ev: float = 0.0
    ) -> display.DisplayTransform:
        """Return the display transform of a new picture (`render`), with its exposure metered.

        `of` names the rule; `auto`: the rule that explains the photographs, or else the mean
        exposure. `exposure_ev` is added, stops.
        """
        readings = meter(np.asarray(rendered.linear), np.asarray(rendered.alpha))
        exposure = self.metering.exposure(readings, of) * 2**exposure_ev
        return replace(self.common_display(), exposure=exposure)


def load_run(folder: str | Path, scene: str | Path | None = None, *, snapshot: bool = False) -> Run:
    """Read parameters, configuration and cameras of a finished run.

    Photographs are read when they are needed, and most methods work without them. `scene` is the
    folder of the scene; None: its path during the fit, absolute or relative to the run. `snapshot`
    reads the newest one of an unfinished run: empty slots are transparent, and it has no metering.
    UserError: the folder is not a run, is unfinished or damaged, or is of a version that this one
    cannot read; or `scene` does not exist.
    """
    files = RunFolder(Path(folder))
    if snapshot:
        files = RunFolder(files.root, files.snapshot)
    _require_finished(files)
    saved, options = read_config(files.config)
    if scene is not None and not Path(scene).exists():
        fix = "name the folder of the run's scene with --scene"
        raise UserError(f"{scene} does not exist.", fix=fix)
    root = find(saved, "scene", files.root) if scene is None else Path(scene)
    found = read_scene(files.root, root or files.root / "scene")
    decisions = read_decisions(files.decisions)
    if decisions is None:
        why = f"{files.root} has no {files.decisions.name}: the run is of a version that this one "
        why += "cannot read, or the file was removed."
        raise UserError(why, fix="restore it from a copy, or fit again")
    cfg = decisions.resolve(options)
    gaussians = read_ply(files.radiance)
    owner, moving = read_objects(files.objects, found, gaussians.capacity)
    photometry_file = photometry_files.read_photometry(files.photometry)
    photometry = photometry_of(photometry_file, found, cfg, files.photometry)
    appearance, kind = None, cfg.photometry.appearance
    if kind is not None:
        path, views = files.appearance(kind), found.training_views
        appearance = photometry_files.read_appearance(path, kind, views)
    return Run(
        files.root,
        Params(gaussians, photometry, appearance),
        cfg,
        found,
        find(saved, "reference", files.root),
        photometry_file,
        owner,
        moving,
    )


def _require_finished(files: RunFolder) -> None:
    if not files.config.is_file():
        why = f"{files.root} is not a run folder: {files.config.name} is missing."
        fix = "name the folder that was given to `p2gs-jax fit --out`; splats of another program "
        fix += "need `render` or `export` with --photometry (docs/exports.md)"
        raise UserError(why, fix=fix)
    for path in (files.radiance, files.photometry):
        if not path.is_file():
            fix = "finish it with `p2gs-jax fit ... --resume`"
            raise UserError(f"{files.root} is unfinished: {path.name} is missing.", fix=fix)


def photometry_of(
    saved: photometry_files.PhotometryFile, scene: Scene, cfg: FitConfig, path: Path
) -> Photometry:
    """Return exposures, gammas and white balances of the training views from a file's content.

    UserError: the file lacks those of a view.
    """
    by_name = {v["image"]: v for v in saved["views"] if v["exposure"] is not None}
    train = [by_name[v.name] for v in scene.training_views if v.name in by_name]
    if len(train) < len(scene.train_indices):
        why = f"{path} does not belong to the scene {scene.root}: its training views "
        why += "differ."
        raise UserError(why, fix="restore the scene folder as it was during the fit")
    exposures, gammas = (np.array([v[name] for v in train]) for name in ("exposure", "gamma"))
    p, balances = cfg.photometry, None
    if p.parameterization == "log":
        exposures, gammas = np.log(exposures), np.log(gammas / GAMMA_SRGB)
    if p.white_balance is not None:
        factors = [v.get("white_balance") for v in train]
        if None in factors:
            raise UserError(
                f"{path} lacks the white balance of a view.", fix=photometry_files.AGAIN
            )
        balances = on_device(np.log(np.array(factors, float)))
    rows = camera_rows([view.camera for view in scene.training_views], p)
    return Photometry(on_device(exposures), on_device(gammas), p.parameterization, balances, rows)


def require_as_begun(folder: Path, scene: Scene, cfg: FitConfig) -> None:
    """Raise UserError: a run began with other photographs, cameras or known exposures than now."""
    known = cfg.photometry.known
    if known not in (None, "exif") and not Path(known).is_file():
        return  # the exposures are part of the key, and their file was moved
    begun = read_config(RunFolder(folder).config)[0].get("photographs")
    if begun != recognition_key(scene.views, known):
        why = f"{folder} was begun with other photographs, cameras, held-out views or known "
        why += f"exposures than {scene.root} and the options name now."
        raise UserError(why, fix="restore them as they were, or fit again in another folder")


def read_config(path: Path) -> tuple[dict[str, Any], FitConfig]:
    """Return `config.json` and its configuration; UserError: it is broken or of another version."""
    with readable(path, CONFIG_AGAIN):
        saved = parse_json(path.read_text(encoding="utf-8"))
    if not isinstance(saved, dict) or not isinstance(saved.get("fit"), dict):
        raise UserError(f"{path} is incomplete: it holds no options.", fix=CONFIG_AGAIN)
    try:
        return saved, from_dict(saved["fit"])
    except (ValueError, KeyError, TypeError) as error:
        why = f"{path} is of another version of this program: {error}."
        fix = "open the run with the version that made it, or fit again with this one"
        raise UserError(why, fix=fix) from error
