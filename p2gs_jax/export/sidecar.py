"""`linear.json`: the data that another program needs to render `linear.ply` as we do.

docs/exports.md describes the fields; raise VERSION whenever their meaning changes.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32

from p2gs_jax.config import Appearance, FitConfig, PhotometryConfig
from p2gs_jax.photometry.display import DisplayTransform, develop
from p2gs_jax.photometry.formation import EXPOSED_CEILING, EXPOSED_FLOOR
from p2gs_jax.render.harmonics import C0, C1, C2, C3, LOG_RADIANCE_LIMIT, degree_of
from p2gs_jax.run.folder import RunFolder
from p2gs_jax.run.photometry_files import PhotometryFile, ViewPhotometry
from p2gs_jax.scene import ImageStore
from p2gs_jax.scene.convert.icc import BT709
from p2gs_jax.types import GAMMA_SRGB, Gaussians, Scene

FORMAT, VERSION = "p2gs-jax linear Gaussians", 2
ACTIVATIONS = {
    "exp": f"L = exp(clip(s, -{LOG_RADIANCE_LIMIT:g}, {LOG_RADIANCE_LIMIT:g}))",
    "linear": "L = max(0, s + 1/2)",
}
# The basis of render/harmonics.py, in order; d = (x, y, z) is the direction.
BASIS = (
    f"{C0}",
    f"-{C1} * y",
    f"{C1} * z",
    f"-{C1} * x",
    f"{C2[0]} * x * y",
    f"-{C2[0]} * y * z",
    f"{C2[1]} * (2 * z * z - x * x - y * y)",
    f"-{C2[0]} * x * z",
    f"{C2[2]} * (x * x - y * y)",
    f"-{C3[0]} * y * (3 * x * x - y * y)",
    f"{C3[1]} * x * y * z",
    f"-{C3[2]} * y * (4 * z * z - x * x - y * y)",
    f"{C3[3]} * z * (2 * z * z - 3 * x * x - 3 * y * y)",
    f"-{C3[2]} * x * (4 * z * z - x * x - y * y)",
    f"{C3[4]} * z * (x * x - y * y)",
    f"-{C3[0]} * x * (x * x - 3 * y * y)",
)
# The columns of the PLY.
FIELDS = {
    "mean": "x, y, z: centre, scene units",
    "opacity": "opacity: peak opacity is 1 / (1 + exp(-opacity))",
    "scale": "scale_0..2: standard deviations along the rotated axes are exp(scale), scene units",
    "rotation": "rot_0..3: quaternion w, x, y, z, not normalised, from the Gaussian's axes to the "
    "world's",
    "normals": "nx, ny, nz: 0, unused",
    "spherical_harmonics": "coefficient 0 of channel c is f_dc_c; coefficient k > 0 is "
    "f_rest_(c (K - 1) + k - 1); K is `coefficients`",
}
# Range of the tabulated tone curve, stops from exposed radiance 1, and the number of samples.
DARKEST_EV, BRIGHTEST_EV, SAMPLES = -14.0, 4.0, 433


def corrections_name(kind: Appearance) -> str:
    """Return the name of the file with learned corrections beside the sidecar."""
    return f"linear.{RunFolder(Path()).appearance(kind).name}"


def linear_sidecar(
    gaussians: Gaussians,
    cfg: FitConfig,
    scene: Scene,
    store: ImageStore,
    photometry: PhotometryFile,
) -> dict[str, Any]:
    """Return the content of the JSON file beside the PLY of these Gaussians.

    `cfg` has the model and curve of the fit, `store` the cameras at its image size.
    """
    count, coefficients = gaussians.sh.shape[:2]
    return {
        "format": FORMAT,
        "version": VERSION,
        "ply": "linear.ply",
        "gaussians": count,
        "fields": FIELDS,
        "spherical_harmonics": {
            "degree": degree_of(coefficients),
            "coefficients": coefficients,
            "direction": "unit vector (x, y, z) from the camera to the Gaussian's centre, world "
            "axes",
            "basis": list(BASIS[:coefficients]),
        },
        "radiance": {
            "activation": cfg.render.radiance,
            "formula": ACTIVATIONS[cfg.render.radiance]
            + " of the sum s of coefficients times basis, by channel",
            "color_space": "linear light, primaries and white of BT.709 (the photographs' sRGB)",
            "chromaticities": list(BT709),
            "unit": "relative; a view's factors convert it to the input of its tone curve "
            "(tone.formula)",
        },
        "rendering": {
            "compositing": "front to back, by alpha, in linear light, over `background`",
            "background": list(cfg.render.background or (0.0, 0.0, 0.0)),
            "blur_px2": cfg.render.blur,
            "alpha_cutoff": cfg.render.alpha_cutoff,
            "alpha_max": cfg.render.alpha_max,
            "near": cfg.render.near,
        },
        "world": {
            "axes": f"right-handed, the axes of the scene that was read ({scene.format})",
            "unit": "scene units: metres where the source is metric",
            "origin": list(scene.origin),
            "viewmat": "world to camera, for column vectors; camera axes x right, y down, "
            "z forward",
            "K": "pixels; the first pixel covers [0, 1]",
        },
        "gauge": photometry["gauge"],
        "tone": _tone(cfg, photometry),
        "mean": photometry["mean"],
        "views": _views(scene, store, {v["image"]: v for v in photometry["views"]}),
    }


def _tone(cfg: FitConfig, photometry: PhotometryFile) -> dict[str, Any]:
    p, kind = cfg.photometry, cfg.photometry.appearance
    exposed = np.exp2(np.linspace(DARKEST_EV, BRIGHTEST_EV, SAMPLES)).astype(np.float32)
    return {
        "formula": f"display = base(pivot * (e * W * V * L / pivot) ** ({GAMMA_SRGB} / gamma)); "
        "e * W * V * L is first clipped to exposed_limits; W is the view's white_balance by "
        "channel, or 1 if it is null; V is its camera's vignetting, or 1 if that is null; base is "
        "the tabulated curve, or the curve of its camera",
        "vignetting": "log V = k1 r^2 + k2 r^4 + k3 r^6 with one row k1, k2, k3 for all channels "
        "or for each; r is the distance from the image's centre divided by half its diagonal",
        "model": photometry["model"],
        "curve": photometry["curve"]["name"],
        "pivot": p.pivot,
        "exposed_limits": [EXPOSED_FLOOR, EXPOSED_CEILING if p.clamp else None],
        "base": {"linear": exposed, "display": _base(exposed, p, None)[:, 0]},
        "cameras": [
            {
                "name": camera.name,
                "vignetting": camera.vignetting or None,
                "base": _base(exposed, p, row).T if camera.splines else None,
            }
            for row, camera in enumerate(p.cameras)
        ],
        "correction": None if kind is None else {"kind": kind, "file": corrections_name(kind)},
    }


def _base(
    exposed: Float[np.ndarray, " s"], p: PhotometryConfig, camera: int | None
) -> Float32[np.ndarray, "s 3"]:
    """Return display values of greys under the curves of a camera (None: the mean curves)."""
    grey = np.repeat(exposed[:, None], 3, 1)
    transform = DisplayTransform(1.0, GAMMA_SRGB, p, camera=camera).without_place()
    return develop(grey, transform)


def _views(
    scene: Scene, store: ImageStore, photometry: Mapping[str, ViewPhotometry]
) -> list[dict[str, Any]]:
    keys = ("exposure", "exposure_ev", "exposure_ev_error", "gamma", "exposure_fitted")
    keys += ("white_balance", "white_balance_ev_error")
    out = []
    for index, view in enumerate(scene.views):
        viewmat, K, width, height = store.camera(index)
        values = {key: photometry.get(view.name, {}).get(key) for key in keys}
        camera = {"width": width, "height": height, "K": K, "viewmat": viewmat}
        name = {"image": view.name, "camera": view.camera, "split": view.split}
        out.append({**name, **values, **camera})
    return out
