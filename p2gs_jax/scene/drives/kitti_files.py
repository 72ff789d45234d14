"""Files that KITTI's data sets share, and when its laser scanner looked where."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float64

from p2gs_jax.errors import UserError
from p2gs_jax.scene.drives.recording import SweepPoints
from p2gs_jax.scene.drives.spin import turned
from p2gs_jax.scene.drives.tables import missing_file
from p2gs_jax.scene.rigid import interpolated

PHOTOGRAPHS = (".png", ".jpg", ".jpeg")
# Seconds of a turn of the scanner, where no file says when it began and ended.
TURN_S = 0.1
# It turns clockwise from its back (x forward, y left), and triggers the cameras when it looks
# forward. KITTI's readme says counterclockwise; the authors' own correction of moving scans
# (kitti360scripts/helpers/curlVelodyneData_impl.c) takes points on the left as the earlier ones.
BACK = np.pi
_STAMP = re.compile(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d(\.\d+)?")


def read_named(path: Path) -> dict[str, Float64[np.ndarray, " n"]]:
    """Return the lists of numbers of a calibration file, by name; other lines are left out.

    Args:
        path: lines `NAME: numbers`.

    Raises:
        UserError: it is missing.
    """
    found = {}
    for line in _lines(path):
        name, colon, rest = line.partition(":")
        try:
            values = np.array([float(word) for word in rest.split()])
        except ValueError:
            continue
        if colon and len(values):
            found[name.strip()] = values
    return found


def named_matrix(
    held: dict[str, Float64[np.ndarray, " n"]], name: str, shape: tuple[int, ...], path: Path
) -> Float64[np.ndarray, "*shape"]:
    """Return one of them as a matrix.

    Raises:
        UserError: it is not there, or has another size, or is not finite.
    """
    values = held.get(name)
    if values is None or values.size != np.prod(shape) or not np.isfinite(values).all():
        wanted = "x".join(map(str, shape))
        raise UserError(
            f"{path} has no {name} of {wanted} finite numbers", fix="get the calibration again"
        )
    return values.reshape(shape)


def read_stamps(path: Path) -> Float64[np.ndarray, " n"]:
    """Return the times of a `timestamps.txt` in seconds, to about a microsecond.

    Args:
        path: lines `YYYY-MM-DD HH:MM:SS.nnnnnnnnn`, one a frame; NaN for empty ones.

    Raises:
        UserError: it is missing, or a line is no time.
    """
    lines = _lines(path)
    while lines and not lines[-1].strip():
        lines.pop()
    times = []
    for number, line in enumerate(lines, 1):
        text = line.strip()
        try:
            if text and not _STAMP.fullmatch(text):
                raise ValueError(text)
            stamp = np.datetime64(text.replace(" ", "T") or "NaT", "ns")
        except ValueError:
            raise UserError(
                f"{path}, line {number}: {text!r} is no date and time",
                fix="get the file again",
            ) from None
        times.append(np.nan if np.isnat(stamp) else stamp.astype(np.int64) * 1e-9)
    return np.array(times)


def read_points(path: Path) -> Float64[np.ndarray, "n 3"]:
    """Return the points of a scan, metres: x forward, y left, z up.

    Args:
        path: float32 x y z reflectance.

    Raises:
        UserError: it is missing or cut off.
    """
    try:
        values = np.fromfile(path, "<f4")
    except FileNotFoundError:
        raise missing_file(path) from None
    if values.size % 4 or path.stat().st_size % 16:
        raise UserError(
            f"{path} is no LiDAR scan: its size is no multiple of float32 x y z reflectance",
            fix="get the file again; it may be cut off",
        )
    return values.reshape(-1, 4)[:, :3].astype(np.float64)


def rectified_camera(
    P: Float64[np.ndarray, "3 4"], path: Path, name: str
) -> tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, "4 4"]]:
    """Return K (pixel centres at +0.5) and this camera to the reference camera.

    Args:
        P: projection from the rectified reference camera, pixel centres at integers.
        path: file, for complaints.
        name: of the camera.

    Raises:
        UserError: P has no focal lengths.
    """
    if not (P[0, 0] > 0 and P[1, 1] > 0 and P[2, 2] > 0):
        raise UserError(
            f"{path}: the projection of {name} has no focal lengths",
            fix="get the calibration again",
        )
    K = P[:, :3].copy()
    back = np.eye(4)
    back[:3, 3] = -np.linalg.solve(K, P[:, 3])
    K[:2, 2] += 0.5
    return K, back


def passed(
    points: Float64[np.ndarray, "n 3"], forward_s: float, turn_s: float = TURN_S
) -> Float64[np.ndarray, " n"]:
    """Return when the scanner looked at points, seconds.

    Args:
        points: in its own axes; those that are not finite count as forward.
        forward_s: when it looked forward.
        turn_s: how long a turn took.
    """
    azimuth = np.nan_to_num(np.arctan2(points[:, 1], points[:, 0]))
    return forward_s + turn_s * (turned(azimuth, start=BACK) - 0.5)


def untwisted(
    points: Float64[np.ndarray, "n 3"],
    at: Float64[np.ndarray, " n"],
    times: Float[np.ndarray, " k"],
    poses: Float64[np.ndarray, "k 4 4"],
) -> SweepPoints:
    """Return the points of a scan in the world, each from where the scanner was at its time.

    Args:
        points: in the scanner's axes at their own times.
        at: these, seconds.
        times: seconds, rising.
        poses: scanner to world at these.
    """
    placed, _ = interpolated(times, poses, at)
    return SweepPoints(np.einsum("nij,nj->ni", placed[:, :3, :3], points) + placed[:, :3, 3], at)


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text(errors="replace").splitlines()
    except FileNotFoundError:
        raise missing_file(path) from None
