"""`cameras.json`: the cameras of the photographs in the words of Blender and of Unreal.

Both worlds are the one of `display.usdc`, as each program imports it: x right, and what COLMAP has
down is down. docs/exports.md describes the fields; a change of their meaning raises VERSION.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from p2gs_jax.formats.usd import APERTURE_MM, NamedCamera
from p2gs_jax.run.photometry_files import (
    ViewPhotometry,
)

FORMAT, VERSION = "p2gs-jax cameras", 1
# Ours are right, down, forward. Blender: right, forward, up; right-handed.
BLENDER = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
# Unreal, as it imports stages with y up: x right, y towards the viewer, z up; left-handed.
UNREAL = np.array([[1.0, 0, 0], [0, 0, -1], [0, -1, 0]])
CENTIMETRES = 100.0


def cameras_table(
    cameras: Sequence[NamedCamera], photometry: Sequence[ViewPhotometry]
) -> dict[str, Any]:
    """Return the content of `cameras.json`.

    Args:
        cameras: of all photographs, at the size of the fit.
        photometry: exposures of the views.
    """
    said = {view["image"]: view for view in photometry}
    return {
        "format": FORMAT,
        "version": VERSION,
        "units": "Blender: scene units; Unreal: hundredths of them; angles in degrees",
        "views": [_row(camera, said[camera.name]) for camera in cameras],
    }


def _row(camera: NamedCamera, said: ViewPhotometry) -> dict[str, Any]:
    exposure = said["exposure_fitted"] if said["exposure"] is None else said["exposure"]
    pose = np.linalg.inv(np.asarray(camera.viewmat, np.float64))
    return {
        "image": camera.name,
        "exr": f"exr/{camera.name.rpartition('.')[0] or camera.name}.exr",
        "camera": said["camera"],
        "split": said["split"],
        "exposure_ev": None if exposure is None else float(np.log2(exposure)),
        "width": camera.width,
        "height": camera.height,
        "K": np.asarray(camera.K, float).tolist(),
        "camera_to_world": pose[:3].tolist(),
        "blender": _blender(camera, pose),
        "unreal": _unreal(camera, pose),
    }


def _blender(camera: NamedCamera, pose: Float[np.ndarray, "4 4"]) -> dict[str, Any]:
    """Return a camera as `bpy` has it; it looks along its -z, with y up."""
    K, width, height = np.asarray(camera.K, float), camera.width, camera.height
    aspect = K[0, 0] / K[1, 1]
    world = np.eye(4)
    world[:3, :3] = BLENDER @ pose[:3, :3] @ np.diag([1.0, -1.0, -1.0])
    world[:3, 3] = BLENDER @ pose[:3, 3]
    return {
        "matrix_world": world.tolist(),
        "sensor_fit": "HORIZONTAL",
        "sensor_width": APERTURE_MM,
        "lens": APERTURE_MM * K[0, 0] / width,
        "shift_x": (width / 2 - K[0, 2]) / width,
        "shift_y": (K[1, 2] - height / 2) * aspect / width,
        # Blender takes none below 1.
        "pixel_aspect_x": max(1.0, 1 / aspect),
        "pixel_aspect_y": max(1.0, aspect),
    }


def _unreal(camera: NamedCamera, pose: Float[np.ndarray, "4 4"]) -> dict[str, Any]:
    """Return a CineCamera: it looks along its x, with y right and z up; rotations as a rotator."""
    K, width, height = np.asarray(camera.K, float), camera.width, camera.height
    right, down, forward = (UNREAL @ pose[:3, :3]).T
    return {
        "location": (CENTIMETRES * UNREAL @ pose[:3, 3]).tolist(),
        "rotation": {
            "pitch": float(np.degrees(np.arctan2(forward[2], np.hypot(forward[0], forward[1])))),
            "yaw": float(np.degrees(np.arctan2(forward[1], forward[0]))),
            "roll": float(np.degrees(np.arctan2(-right[2], -down[2]))),
        },
        "field_of_view": float(np.degrees(2 * np.arctan(width / (2 * K[0, 0])))),
        "sensor_width": APERTURE_MM,
        "sensor_height": APERTURE_MM * height / width * K[0, 0] / K[1, 1],
        "focal_length": APERTURE_MM * K[0, 0] / width,
        "sensor_horizontal_offset": APERTURE_MM * (width / 2 - K[0, 2]) / width,
        "sensor_vertical_offset": APERTURE_MM * (K[1, 2] - height / 2) / width * K[0, 0] / K[1, 1],
    }
