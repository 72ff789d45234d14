"""Reading a finished run back."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Array, Bool

from p2gs_jax.config import FitConfig, PhotometryConfig, from_dict
from p2gs_jax.errors import UserError
from p2gs_jax.evaluate.evaluate import MeanParameters, mean_parameters
from p2gs_jax.export.photometry_json import PhotometryFile, read_photometry
from p2gs_jax.export.ply import read_ply
from p2gs_jax.finish import APPEARANCE
from p2gs_jax.numerics import on_device
from p2gs_jax.photometry.appearance import identity
from p2gs_jax.photometry.look import Look
from p2gs_jax.scene import load_scene
from p2gs_jax.types import GAMMA_SRGB, Params, Photometry, Scene


@dataclass(frozen=True)
class Run:
    """A finished run.

    Attributes:
        folder: where it lies.
        params: the fit.
        cfg: how it was made.
        scene: what it was fitted to.
        reference: photographs under one common exposure, or None.
        photometry: `photometry.json`, with what `params` does not hold: standard errors, EXIF,
            exposures fitted to held-out photographs.
    """

    folder: Path
    params: Params
    cfg: FitConfig
    scene: Scene
    reference: Path | None
    photometry: PhotometryFile

    @property
    def alive(self) -> Bool[Array, " n"]:
        """All Gaussians: a finished run keeps no empty slots."""
        return on_device(np.ones(self.params.gaussians.capacity), bool)

    @property
    def mean(self) -> MeanParameters:
        """Exposure and gamma of a view that has none of its own."""
        return mean_parameters(self.params.photometry)

    def own_look(self, index: int) -> Look:
        """Return how a view was taken; a held-out view's exposure is that fitted to its photograph.

        Args:
            index: row in `scene.views`.
        """
        if index in self.scene.train_indices:
            row = self.scene.train_indices.index(index)
            p = self.params.photometry
            e, g = float(p.exposures[row]), float(p.gammas[row])
            return Look(e, g, self.cfg.photometry, self.params.correction(row))
        name = self.scene.views[index].name
        fitted = {v["image"]: v["exposure_fitted"] for v in self.photometry["views"]}.get(name)
        if fitted is None:
            return self.common_look()
        return replace(self.common_look(), exposure=fitted)

    def common_look(self, exposure_ev: float = 0.0) -> Look:
        """Return one look for all views.

        Args:
            exposure_ev: stops from the geometric mean of the training views' exposures.
        """
        mean = self.mean
        return Look(
            mean.exposure_geometric * 2**exposure_ev,
            mean.gamma,
            self.cfg.photometry,
            self.params.mean_correction,
        )


def resolved(cfg: PhotometryConfig, saved: PhotometryFile) -> PhotometryConfig:
    """Return the options with the model and curve that the fit chose.

    Raises:
        UserError: the file names none.
    """
    curve, model = saved["curve"], saved["model"]
    try:
        spline = curve.get("spline")
        return replace(
            cfg,
            select=False,
            model=model,  # pyright: ignore[reportArgumentType]
            curve=curve["name"],
            spline=None if spline is None else tuple(map(float, spline)),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(
            f"photometry.json names no tone curve ({error}).", fix="fit again with this version"
        ) from error


def load_run(folder: Path) -> Run:
    """Read parameters, configuration and scene of a finished run.

    Raises:
        UserError: the folder is no run, is unfinished, or its scene has moved.
    """
    config_path = folder / "config.json"
    if not config_path.is_file():
        raise UserError(
            f"{folder} is not a run folder: {config_path.name} is missing.",
            fix="name the folder that was given to `p2gs-jax fit --out`",
        )
    for name in ("radiance.ply", "photometry.json"):
        if not (folder / name).is_file():
            raise UserError(
                f"{folder} is unfinished: {name} is missing.",
                fix="finish it with `p2gs-jax fit ... --resume`",
            )
    try:
        saved = json.loads(config_path.read_text())
        cfg = from_dict(saved["fit"])
    except (ValueError, KeyError, TypeError) as error:
        raise UserError(
            f"{config_path} cannot be read: {error}.", fix="fit again with this version"
        ) from error
    scene = _load_scene(Path(saved["scene"]), cfg, folder)
    gaussians = read_ply(folder / "radiance.ply")
    photometry_file = read_photometry(folder / "photometry.json")
    cfg = replace(cfg, photometry=resolved(cfg.photometry, photometry_file))
    views = {v["image"]: v for v in photometry_file["views"]}
    train = [views.get(scene.views[i].name) for i in scene.train_indices]
    if any(v is None or v["exposure"] is None for v in train):
        raise UserError(
            f"{folder / 'photometry.json'} does not belong to the scene {saved['scene']}: its "
            "training views differ.",
            fix="restore the scene folder as it was during the fit",
        )
    exposures = np.array([v["exposure"] for v in train if v is not None])
    gammas = np.array([v["gamma"] for v in train if v is not None])
    if cfg.photometry.parameterization == "log":
        exposures, gammas = np.log(exposures), np.log(gammas / GAMMA_SRGB)
    photometry = Photometry(
        on_device(exposures),
        on_device(gammas),
        cfg.photometry.parameterization,
    )
    reference = saved.get("reference")
    return Run(
        folder,
        Params(gaussians, photometry, _appearance(folder, cfg, len(train))),
        cfg,
        scene,
        None if reference is None else Path(reference),
        photometry_file,
    )


def _load_scene(path: Path, cfg: FitConfig, folder: Path) -> Scene:
    if not path.exists():
        raise UserError(
            f"the scene of this run, {path}, is not there.",
            fix=f"put it back, or correct `scene` in {folder / 'config.json'}",
        )
    return load_scene(path, cfg.data, folder / "cache", lambda text: None)


def _appearance(folder: Path, cfg: FitConfig, views: int):
    """Return the corrections of display values that the run learned, or None."""
    if cfg.photometry.appearance is None:
        return None
    path = folder / APPEARANCE
    try:
        corrections = np.load(path, allow_pickle=False)
    except (OSError, ValueError) as error:
        raise UserError(
            f"{path} cannot be read: {error}.", fix="finish the fit again with --resume"
        ) from error
    if corrections.shape != identity(cfg.photometry.appearance, views).shape:
        raise UserError(f"{path} does not belong to this run.", fix="fit again")
    return on_device(corrections)
