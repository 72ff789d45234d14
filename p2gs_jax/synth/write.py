"""Writes a street as a scene folder: photographs, their truth, a COLMAP model.

    images/<camera>/<frame>.png      eight-bit sRGB photographs at the drawn ISO
    reference/<camera>/<frame>.png   the same views at ISO 8
    truth/linear/<camera>/<frame>.exr   radiance R G B (half), camera z Z (float; inf: sky)
    truth/sky_masks/<camera>/<frame>.png   255 where the pixel's centre sees the sky
    truth/exposures.csv              image, camera, iso, exposure, exposure_ev
    sparse/0/*.bin                   PINHOLE cameras, poses, seed points with tracks
    dataset.json                     every parameter

`images/` and `sparse/` are all that a fit may see. The folder appears whole or not at all.
"""

from __future__ import annotations

import csv
import json
import shutil
import struct
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import OpenEXR
from jaxtyping import Bool, Float, Float32, Float64, Int, UInt8
from PIL import Image
from scipy.spatial.transform import Rotation

from p2gs_jax.errors import UserError
from p2gs_jax.synth.rig import MOUNTS, camera_viewmat, drive, intrinsics
from p2gs_jax.synth.sensor import ISO_REFERENCE, draw_iso, photograph
from p2gs_jax.synth.town import Town, build_town
from p2gs_jax.synth.tracer import Tracer

FORMAT = "p2gs-jax street, version 1"
_DEPTH_TOLERANCE = 0.01
_SEED_RANGE = 90.0  # m: farther points are not triangulated
_PINHOLE = 1  # COLMAP's model id


class _Views(NamedTuple):
    """The photographs as COLMAP needs them."""

    names: Sequence[str]
    cameras: Sequence[str]
    viewmats: Float64[np.ndarray, "v 4 4"]
    K: Float64[np.ndarray, "3 3"]
    width: int
    height: int


@dataclass(frozen=True)
class StreetTruth:
    """What was written, one row per photograph, sorted by name.

    Attributes:
        root: the scene folder.
        names: relative to `images/`.
        cameras: physical camera of each photograph.
        viewmats: world-to-camera, OpenCV axes, m.
        K: intrinsics of all cameras, pixels, centres at +0.5.
        width: pixels.
        height: pixels.
        iso: drawn ISO.
        exposures: iso / 8.
        points: number of seed points.
        observations: number of their observations.
    """

    root: Path
    names: tuple[str, ...]
    cameras: tuple[str, ...]
    viewmats: Float64[np.ndarray, "v 4 4"]
    K: Float64[np.ndarray, "3 3"]
    width: int
    height: int
    iso: Int[np.ndarray, " v"]
    exposures: Float64[np.ndarray, " v"]
    points: int
    observations: int

    def linear(self, row: int) -> Float32[np.ndarray, "h w 3"]:
        """Return the true linear radiance of a view; 1 is white at ISO 8."""
        return read_truth(self._truth(row))[0]

    def depth(self, row: int) -> Float32[np.ndarray, "h w"]:
        """Return the true camera z at the pixel centres, m; inf: sky."""
        return read_truth(self._truth(row))[1]

    def _truth(self, row: int) -> Path:
        return (self.root / "truth" / "linear" / self.names[row]).with_suffix(".exr")


def write_street(
    out: Path,
    *,
    frames: int = 10,
    width: int = 320,
    height: int = 216,
    iso_std: float = 4.0,
    seed: int = 0,
    supersample: int = 2,
    step: float = 0.9,
    points: int = 24_000,
    hold_out: int = 8,
    report: Callable[[str], None] | None = None,
) -> StreetTruth:
    """Render a drive along the procedural street and write it as a scene folder.

    Args:
        out: the folder to make; it must not exist, or be empty.
        frames: of each of the three cameras.
        width: pixels (paper: 1920).
        height: pixels (paper: 1300).
        iso_std: spread of the ISO (paper: 2 and 4); 0 writes ISO-Const.
        seed: of the town, the ISO and the points.
        supersample: samples a pixel along each axis.
        step: metres between frames.
        points: seed points to sample; those seen once are dropped.
        hold_out: no points are sampled in every n-th frame, as they may be held out; 0: in all.
        report: receives a line of progress now and then.

    Raises:
        UserError: a parameter is impossible, or `out` is in the way.
    """
    _check(out, frames, width, height, iso_std, supersample)
    say = report or (lambda line: None)
    out = Path(out)
    out.parent.mkdir(parents=True, exist_ok=True)
    town = build_town(seed)
    names = tuple(f"{camera}/{f:06d}.png" for camera in sorted(MOUNTS) for f in range(frames))
    cameras = tuple(name.split("/")[0] for name in names)
    frame = np.tile(np.arange(frames), len(MOUNTS))
    track = drive(frames, step=step)
    viewmats = np.stack(
        [camera_viewmat(MOUNTS[c], track[f]) for c, f in zip(cameras, frame, strict=True)]
    )
    iso = draw_iso((frames, len(MOUNTS)), iso_std, seed).T.ravel()
    K = intrinsics(width, height)
    temporary = Path(tempfile.mkdtemp(prefix=f".{out.name}-", dir=out.parent))
    temporary.chmod(0o755)
    try:
        photographs, depths = [], []
        say(f"rendering {len(names)} views of a street with {town.size} solids")
        for row, (linear, depth) in enumerate(
            _render_all(town, viewmats, K, width, height, supersample)
        ):
            photographs.append(_write_view(temporary, names[row], linear, depth, float(iso[row])))
            depths.append(depth)
            if (row + 1) % 10 == 0:
                say(f"rendered {row + 1} of {len(names)} views")
        sampled = np.ones(frames, bool)
        if hold_out and frames > 1:
            sampled[::hold_out] = False
        xyz, rgb = _seeds(viewmats, K, photographs, depths, sampled[frame], points, seed)
        xy, seen = _observations(xyz, viewmats, K, depths)
        kept = seen.sum(0) >= 2
        xyz, rgb, xy, seen = xyz[kept], rgb[kept], xy[:, kept], seen[:, kept]
        views = _Views(names, cameras, viewmats, K, width, height)
        _write_colmap(temporary / "sparse" / "0", views, xyz, rgb, xy, seen)
        _write_exposures(temporary / "truth" / "exposures.csv", names, cameras, iso)
        card = {
            "format": FORMAT,
            "seed": seed,
            "frames": frames,
            "cameras": {name: asdict(mount) for name, mount in MOUNTS.items()},
            "width": width,
            "height": height,
            "K": K.tolist(),
            "supersample": supersample,
            "step_m": step,
            "iso_std": iso_std,
            "iso_reference": ISO_REFERENCE,
            "hold_out": hold_out,
            "points_sampled": points,
            "points": len(xyz),
            "observations": int(seen.sum()),
            "solids": town.size,
            "light": asdict(town.light),
        }
        (temporary / "dataset.json").write_text(json.dumps(card, indent=2) + "\n")
        if out.exists():
            out.rmdir()  # empty, or it would have been refused
        temporary.rename(out)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise
    say(f"wrote {out}: {len(names)} photographs, {len(xyz)} points, {int(seen.sum())} observations")
    return StreetTruth(
        root=out,
        names=names,
        cameras=cameras,
        viewmats=viewmats,
        K=K,
        width=width,
        height=height,
        iso=iso,
        exposures=iso / ISO_REFERENCE,
        points=len(xyz),
        observations=int(seen.sum()),
    )


def read_truth(path: Path) -> tuple[Float32[np.ndarray, "h w 3"], Float32[np.ndarray, "h w"]]:
    """Return linear radiance and camera z (m, inf: sky) from a truth EXR."""
    with OpenEXR.File(str(path), separate_channels=True) as file:
        pixels = {name: np.array(c.pixels, np.float32) for name, c in file.channels().items()}
    return np.stack([pixels[c] for c in "RGB"], axis=-1), pixels["Z"]


def _check(
    out: Path, frames: int, width: int, height: int, iso_std: float, supersample: int
) -> None:
    if frames < 1 or width < 16 or height < 16 or iso_std < 0 or supersample < 1:
        raise UserError(
            f"cannot render {frames} frames of {width}x{height} with {supersample} samples a side "
            f"and ISO std {iso_std}",
            fix="use at least 1 frame, 16x16 pixels, 1 sample, and a spread of 0 or more",
        )
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise UserError(f"{out} exists and is not an empty folder", fix="name another folder")


def _render_all(
    town: Town, viewmats: np.ndarray, K: np.ndarray, width: int, height: int, supersample: int
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield (linear as half floats, depth) of every view; two views are rendered at a time."""
    tracer = Tracer(town)

    def one(viewmat: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        linear, depth = tracer.render(viewmat, K, width, height, supersample)
        return linear.astype(np.float16), depth

    yield one(viewmats[0])  # compiles once, not once a thread
    with ThreadPoolExecutor(2) as pool:
        yield from pool.map(one, viewmats[1:])


def _write_view(
    root: Path, name: str, linear: np.ndarray, depth: np.ndarray, iso: float
) -> UInt8[np.ndarray, "h w 3"]:
    shot = photograph(linear, iso / ISO_REFERENCE)
    sky = np.where(np.isinf(depth), np.uint8(255), np.uint8(0))
    for folder, pixels in (
        ("images", shot),
        ("reference", photograph(linear, 1.0)),
        ("truth/sky_masks", sky),
    ):
        path = root / folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(pixels).save(path, compress_level=4)
    path = (root / "truth" / "linear" / name).with_suffix(".exr")
    path.parent.mkdir(parents=True, exist_ok=True)
    channels = {c: np.ascontiguousarray(linear[..., i]) for i, c in enumerate("RGB")}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, channels | {"Z": depth.astype(np.float32)}) as file:
        file.write(str(path))
    return shot


def _seeds(
    viewmats: np.ndarray,
    K: np.ndarray,
    photographs: Sequence[np.ndarray],
    depths: Sequence[np.ndarray],
    sampled: Bool[np.ndarray, " v"],
    points: int,
    seed: int,
) -> tuple[Float64[np.ndarray, "p 3"], UInt8[np.ndarray, "p 3"]]:
    """Sample first hits at random pixels of the sampled views, with the photographs' colours."""
    rng = np.random.default_rng([seed, 3])
    rows = np.flatnonzero(sampled)
    xyz, rgb = [], []
    for row in rows.tolist():
        y, x = np.nonzero(depths[row] < _SEED_RANGE)
        pick = rng.choice(len(x), min(len(x), -(-points // len(rows))), replace=False)
        x, y = x[pick], y[pick]
        ray = np.stack([x + 0.5, y + 0.5, np.ones(len(x))]).T @ np.linalg.inv(K).T
        local = ray * depths[row][y, x].astype(np.float64)[:, None]
        xyz.append((local - viewmats[row][:3, 3]) @ viewmats[row][:3, :3])
        rgb.append(photographs[row][y, x])
    return np.concatenate(xyz), np.concatenate(rgb)


def _observations(
    xyz: Float64[np.ndarray, "p 3"],
    viewmats: np.ndarray,
    K: np.ndarray,
    depths: Sequence[np.ndarray],
) -> tuple[Float64[np.ndarray, "v p 2"], Bool[np.ndarray, "v p"]]:
    """Project the points into every view and tell where they are visible.

    A point is visible where its projection lies among four pixel centres whose depth, interpolated,
    is the point's within 1 %. What is interpolated is 1 / z: exact on planes. Silhouettes, where
    the four pixels see different things, are rejected.
    """
    height, width = depths[0].shape
    xy = np.zeros((len(viewmats), len(xyz), 2))
    seen = np.zeros((len(viewmats), len(xyz)), bool)
    for row, viewmat in enumerate(viewmats):
        local = xyz @ viewmat[:3, :3].T + viewmat[:3, 3]
        z = np.maximum(local[:, 2], 1e-3)
        xy[row] = (local[:, :2] / z[:, None]) * K[[0, 1], [0, 1]] + K[:2, 2]
        # The projection of a pixel centre may come back a rounding error outside its cell.
        u, v = np.round(xy[row].T - 0.5, 6)
        inside = (local[:, 2] > 0.05) & (u >= 0) & (v >= 0) & (u <= width - 1) & (v <= height - 1)
        u, v = np.where(inside, u, 0.0), np.where(inside, v, 0.0)
        i, j = np.minimum(u.astype(int), width - 2), np.minimum(v.astype(int), height - 2)
        a, b = u - i, v - j
        inverse = 1.0 / depths[row].astype(np.float64)
        top = (1 - a) * inverse[j, i] + a * inverse[j, i + 1]
        bottom = (1 - a) * inverse[j + 1, i] + a * inverse[j + 1, i + 1]
        found = (1 - b) * top + b * bottom
        seen[row] = inside & (np.abs(found * z - 1.0) < _DEPTH_TOLERANCE)
    return xy, seen


def _write_exposures(
    path: Path, names: Sequence[str], cameras: Sequence[str], iso: Int[np.ndarray, " v"]
) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(("image", "camera", "iso", "exposure", "exposure_ev"))
        for name, camera, value in zip(names, cameras, iso, strict=True):
            e = value / ISO_REFERENCE
            writer.writerow((name, camera, int(value), f"{e:.6g}", f"{np.log2(e):.6f}"))


def _write_colmap(
    folder: Path,
    views: _Views,
    xyz: Float[np.ndarray, "p 3"],
    rgb: UInt8[np.ndarray, "p 3"],
    xy: Float[np.ndarray, "v p 2"],
    seen: Bool[np.ndarray, "v p"],
) -> None:
    """Write cameras.bin, images.bin, points3D.bin (https://colmap.github.io/format.html)."""
    folder.mkdir(parents=True)
    ids = {camera: i + 1 for i, camera in enumerate(MOUNTS)}
    params = (views.K[0, 0], views.K[1, 1], views.K[0, 2], views.K[1, 2])
    size = (views.width, views.height)
    data = [struct.pack("<Q", len(ids))]
    for camera_id in ids.values():
        data.append(struct.pack("<iiQQ4d", camera_id, _PINHOLE, *size, *params))
    (folder / "cameras.bin").write_bytes(b"".join(data))

    keypoint = np.dtype([("xy", "<f8", 2), ("id", "<i8")])
    data = [struct.pack("<Q", len(views.names))]
    for row, name in enumerate(views.names):
        x, y, z, w = Rotation.from_matrix(views.viewmats[row][:3, :3]).as_quat(canonical=True)
        pose = (w, x, y, z, *views.viewmats[row][:3, 3])
        which = np.flatnonzero(seen[row])
        keypoints = np.empty(len(which), keypoint)
        keypoints["xy"], keypoints["id"] = xy[row, which], which + 1
        data.append(struct.pack("<I7dI", row + 1, *pose, ids[views.cameras[row]]))
        data.append(name.encode() + b"\0" + struct.pack("<Q", len(which)) + keypoints.tobytes())
    (folder / "images.bin").write_bytes(b"".join(data))

    slot = np.cumsum(seen, axis=1) - 1  # the observation's place among its image's keypoints
    point_of, view_of = np.nonzero(seen.T)
    elements = np.stack([view_of + 1, slot[view_of, point_of]], axis=1).astype("<u4")
    ends = np.cumsum(seen.sum(0))
    data = [struct.pack("<Q", len(xyz))]
    for p, end in enumerate(ends):
        track = elements[(ends[p - 1] if p else 0) : end]
        data.append(struct.pack("<Q3d3Bd", p + 1, *xyz[p], *rgb[p].tolist(), 0.0))
        data.append(struct.pack("<Q", len(track)) + track.tobytes())
    (folder / "points3D.bin").write_bytes(b"".join(data))
