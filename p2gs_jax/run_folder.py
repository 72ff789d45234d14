"""Reading a finished run back."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from p2gs_jax.config import FitConfig, PhotometryConfig, from_dict
from p2gs_jax.errors import UserError
from p2gs_jax.export.photometry_json import PhotometryFile, read_photometry
from p2gs_jax.export.ply import read_ply
from p2gs_jax.finish import APPEARANCE
from p2gs_jax.photometry.appearance import identity
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
    """

    folder: Path
    params: Params
    cfg: FitConfig
    scene: Scene
    reference: Path | None


def resolved(cfg: PhotometryConfig, saved: PhotometryFile) -> PhotometryConfig:
    """Return the options with the model and curve that the fit chose.

    Raises:
        UserError: the file names none.
    """
    curve, model = saved["curve"], saved["model"]
    try:
        spline = curve.get("spline")
        return dataclasses.replace(
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
    scene = load_scene(Path(saved["scene"]), cfg.data, folder / "cache", lambda text: None)
    gaussians = read_ply(folder / "radiance.ply")
    photometry_file = read_photometry(folder / "photometry.json")
    cfg = dataclasses.replace(cfg, photometry=resolved(cfg.photometry, photometry_file))
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
        jnp.asarray(exposures, jnp.float32),
        jnp.asarray(gammas, jnp.float32),
        cfg.photometry.parameterization,
    )
    reference = saved.get("reference")
    return Run(
        folder,
        Params(gaussians, photometry, _appearance(folder, cfg, len(train))),
        cfg,
        scene,
        None if reference is None else Path(reference),
    )


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
    return jnp.asarray(corrections)
