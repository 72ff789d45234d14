"""OpenUSD: a ParticleField3DGaussianSplat and a camera for every photograph, through Pixar's pxr.

The stage is right-handed with y up, and one scene unit is stated as one metre. Cameras look along
-z with y up, as USD requires. Their apertures and focal lengths are in tenths of a scene unit.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import expit

from p2gs_jax.core.atomic import atomic_write
from p2gs_jax.errors import UserError
from p2gs_jax.formats.ply import unit_quats
from p2gs_jax.gaussians.posed import FLIP, half_turn
from p2gs_jax.render.harmonics import degree_of
from p2gs_jax.types import Camera, Gaussians

# Width of 35 mm film, to which focal lengths usually refer.
APERTURE_MM = 36.0
TENTHS_PER_MM = 0.01  # tenths of a scene unit, which is 1 m
MODULES = ("Gf", "Usd", "UsdGeom", "UsdVol", "Vt")
SPLATS, CAMERAS = "/scene/splats", "/scene/cameras"


def require_pxr() -> tuple[Any, ...]:
    """Return pxr's Gf, Usd, UsdGeom, UsdVol and Vt, which have no types.

    Raises UserError: OpenUSD is not installed, or is too old for splats.
    """
    try:
        found = [importlib.import_module(f"pxr.{name}") for name in MODULES]
    except ImportError as error:
        why = f"--format usd needs OpenUSD, which cannot be imported ({error})."
        raise UserError(why, fix="pip install 'p2gs-jax[usd]', or export gltf") from error
    if not hasattr(found[3], "ParticleField3DGaussianSplat"):
        why = "this OpenUSD does not support Gaussian splats, which need version 26.03 or later."
        raise UserError(why, fix="pip install --upgrade 'usd-core>=26.3'")
    return tuple(found)


def write_usd(path: Path, gaussians: Gaussians, cameras: Mapping[str, Camera]) -> None:
    """Write Gaussians with display colours, and cameras by the names of their photographs.

    Both have COLMAP's axes.
    """
    _, Usd, UsdGeom, UsdVol, Vt = require_pxr()
    g = half_turn(gaussians)

    def vectors(values: np.ndarray) -> Any:
        return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(values))

    with atomic_write(path) as temporary:
        temporary.unlink()
        stage = Usd.Stage.CreateNew(str(temporary))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/scene").GetPrim())
        field = UsdVol.ParticleField3DGaussianSplat.Define(stage, SPLATS)
        means = np.asarray(g.means, np.float32)
        scales = np.exp(np.asarray(g.log_scales, np.float32))
        quats = unit_quats(g).astype(np.float32)
        sh = np.asarray(g.sh, np.float32)
        values = {
            "positions": vectors(means),
            "scales": vectors(scales),
            # Gf keeps the imaginary part first.
            "orientations": Vt.QuatfArray.FromNumpy(np.roll(quats, -1, axis=1)),
            "opacities": Vt.FloatArray.FromNumpy(expit(np.asarray(g.opacity_logits, np.float32))),
            "radiance:sphericalHarmonicsDegree": degree_of(sh.shape[1]),
            "radiance:sphericalHarmonicsCoefficients": vectors(sh.reshape(-1, 3)),
            "extent": vectors(_extent(means, scales)),
        }
        for name, value in values.items():
            field.GetPrim().GetAttribute(name).Set(value)
        for index, (name, camera) in enumerate(cameras.items()):
            _define_camera(stage, f"{CAMERAS}/view_{index:04d}", name, camera)
        stage.GetRootLayer().Save()


def _extent(means: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """Return the box around all Gaussians up to three of their largest standard deviations."""
    if not len(means):
        return np.zeros((2, 3), np.float32)
    reach = 3 * scales.max(1, keepdims=True)
    return np.stack([(means - reach).min(0), (means + reach).max(0)]).astype(np.float32)


def _define_camera(stage: Any, path: str, name: str, camera: Camera) -> None:
    Gf, _, UsdGeom, *_ = require_pxr()
    turn = np.diag([*FLIP, 1.0])
    # Both worlds and both cameras differ by the same half turn.
    pose = turn @ np.linalg.inv(np.asarray(camera.viewmat, np.float64)) @ turn
    K, width, height = np.asarray(camera.K), camera.width, camera.height
    aperture = APERTURE_MM * TENTHS_PER_MM
    pixel_width = aperture / width
    pixel_height = pixel_width * K[0, 0] / K[1, 1]
    prim = UsdGeom.Camera.Define(stage, path)
    # USD multiplies row vectors.
    prim.AddTransformOp().Set(Gf.Matrix4d(pose.T.tolist()))
    prim.CreateFocalLengthAttr(float(K[0, 0] * pixel_width))
    prim.CreateHorizontalApertureAttr(aperture)
    prim.CreateVerticalApertureAttr(float(height * pixel_height))
    prim.CreateHorizontalApertureOffsetAttr(float((width / 2 - K[0, 2]) * pixel_width))
    prim.CreateVerticalApertureOffsetAttr(float((K[1, 2] - height / 2) * pixel_height))
    prim.GetPrim().SetMetadata("comment", name)
