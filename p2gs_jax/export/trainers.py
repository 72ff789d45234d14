"""Solved photometry in the files of other trainers: PPISP (gsplat, LichtFeld), 3DGS, nerfstudio.

docs/exports.md explains how to pass each file to its program.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path, PurePosixPath

import numpy as np

from p2gs_jax.core.atomic import write_json
from p2gs_jax.photometry.ppisp_start import start_of
from p2gs_jax.run.foreign import common_look
from p2gs_jax.run.photometry_files import PhotometryFile, read_photometry
from p2gs_jax.run.scene_file import folder_of, relative_path
from p2gs_jax.types import GAMMA_SRGB, View


def write_for(
    trainers: Sequence[str], folder: Path, views: Sequence[View], scene: Path
) -> list[str]:
    """Write the files of some trainers beside the `photometry.json` of a calibration.

    `views` are the calibrated photographs of `scene`, a folder or a JSON file. Returns a sentence
    on each file, or the reason why it is not written: the program cannot express this photometry.
    """
    saved = read_photometry(folder / "photometry.json")
    nerfstudio = partial(_nerfstudio, base=folder_of(scene))
    writers = {"ppisp": _ppisp, "3dgs": _3dgs, "nerfstudio": nerfstudio}
    return [writers[name](folder, saved, views) for name in dict.fromkeys(trainers)]


def _ppisp(folder: Path, saved: PhotometryFile, views: Sequence[View]) -> str:
    """Write PPISP's parameters under its names; a view without an exposure gets the common one."""
    path, common = folder / "ppisp_start.json", common_look(folder, saved)
    rows = {row["image"]: row for row in saved["views"]}
    found = [rows[view.name] for view in views]
    start = start_of(
        common.formation,
        [view.camera for view in views],
        np.array([row["exposure"] or common.exposure for row in found]),
        np.array([row["gamma"] or common.gamma for row in found]),
        np.log([row["white_balance"] or [1.0] * 3 for row in found]),
        {view.camera: (view.width, view.height) for view in views},
    )
    p = start.parameters
    content = {
        "exposure_params": p.exposures,
        "vignetting_params": p.vignettings,
        "color_params": p.colors,
        "crf_params": p.responses,
        "frames": [view.name for view in views],
        "cameras": p.names,
        "camera_of_frame": p.cameras,
        "radiance_ev": start.radiance_ev,
        "codes": start.codes,
    }
    write_json(path, content)
    return (
        f"{path}: initial values of PPISP. Its response differs from the solved one by "
        f"{start.codes[:, 0].mean():.1f} 8-bit codes in the mean, at most {start.codes.max():.0f}."
    )


def _3dgs(folder: Path, saved: PhotometryFile, views: Sequence[View]) -> str:
    """Write 3DGS's matrices if photographs differ only by gains of their display values."""
    path, common = folder / "exposure.json", common_look(folder, saved)
    cameras, curve = common.formation.cameras, common.formation.curve
    gammas = [row["gamma"] for row in saved["views"] if row["gamma"] is not None]
    varied = any(camera.vignetting or camera.splines for camera in cameras)
    if curve not in ("power", "linear") or np.ptp(gammas) > 1e-6 or varied:
        return (
            f"{path.name} is not written: with the curve {curve}, vignetting or gammas that vary, "
            "photographs differ by more than a matrix of 3DGS. Train on developed ones (--develop)."
        )
    power, matrices = (1 if curve == "power" else GAMMA_SRGB) / common.gamma, {}
    for row in saved["views"]:
        e = (row["exposure"] or common.exposure) / common.exposure
        gains = (e * np.array(row["white_balance"] or [1.0] * 3)) ** power
        matrices[row["image"]] = np.concatenate([np.diag(gains), np.zeros((3, 1))], axis=1)
    write_json(path, matrices)
    return f"{path}: matrices of 3DGS, from the common exposure to that of each photograph."


def _nerfstudio(folder: Path, saved: PhotometryFile, views: Sequence[View], *, base: Path) -> str:
    """Write the photometry of every photograph as fields of a frame of `transforms.json`."""
    path, fields = folder / "frames.json", ("exposure_ev", "gamma", "white_balance")
    rows, paths = {row["image"]: row for row in saved["views"]}, _photographs(views, base)
    frames = [
        {"file_path": paths[view.name]} | {name: rows[view.name][name] for name in fields}
        for view in views
    ]
    write_json(path, {"frames": frames})
    return f"{path}: fields of the frames of nerfstudio's transforms.json."


def _photographs(views: Sequence[View], base: Path) -> dict[str, str]:
    """Return the path of each photograph from the scene's folder, by name.

    Views of converted photographs show files of a cache, which are named differently.
    """
    paths = {view.name: relative_path(view.image_path, base) for view in views}
    lost = {view.name for view in views if view.image_path.name != PurePosixPath(view.name).name}
    below = (path.relative_to(base).parts for path in (base.rglob("*.*") if lost else ()))
    # The shallowest file counts, and `images` before smaller copies in `images_2`.
    for parts in sorted(below, key=lambda parts: (len(parts), parts), reverse=True):
        tails = ("/".join(parts[k:]) for k in range(len(parts)))
        paths |= {tail: "/".join(parts) for tail in tails if tail in lost}
    return paths
