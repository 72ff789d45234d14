"""A synthetic drive as a scene folder: photographs, ground truth, and a COLMAP model.

    images/<camera>/<frame>.png      eight-bit photographs at the drawn ISO
    reference/<camera>/<frame>.png   the same views at ISO 8, without gains, vignetting and noise
    truth/linear/<camera>/<frame>.exr   radiance R G B (half), camera z Z (float; inf: sky)
    truth/sky_masks/<camera>/<frame>.png   255 where the pixel's centre sees the sky
    truth/exposures.csv              exposure and camera settings of every photograph, see `sensor`
    sparse/0/*.bin                   PINHOLE cameras, poses, seed points with tracks
    dataset.json                     every parameter

A fit may use everything except `reference/` and `truth/`. The folder is created complete or not at
all.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from PIL import Image

from p2gs_jax.core.atomic import atomic_folder, naming
from p2gs_jax.core.streams import SceneStream, generator
from p2gs_jax.errors import UserError
from p2gs_jax.synth.colmap_files import DriveViews, sample_seeds, write_seeds
from p2gs_jax.synth.furnish import build_town
from p2gs_jax.synth.rig import MOUNTS, camera_viewmat, drive, intrinsics
from p2gs_jax.synth.sensor import ISO_REFERENCE, Shots, draw_shots, photograph, write_true_exposures
from p2gs_jax.synth.settings import Layout, Sensor, check_sensor
from p2gs_jax.synth.town import STREET_END, Town
from p2gs_jax.synth.tracer import Tracer

FORMAT = "p2gs-jax street, version 3"


def write_street(
    out: str | Path,
    *,
    frames: int = 10,
    width: int = 320,
    height: int = 216,
    iso_std: float = 4.0,
    seed: int = 0,
    supersample: int | None = None,
    step: float = 0.9,
    points: int = 24_000,
    hold_out: int = 8,
    sensor: Sensor | None = None,
    layout: Layout = "street",
    matte: bool = False,
    render: Callable[[DriveViews], Iterator[tuple[np.ndarray, np.ndarray]]] | None = None,
    report: Callable[[str], None] = lambda line: None,
) -> Path:
    """Render a drive along the procedural street, write its scene folder and return the path.

    Args:
        out: the new folder, which must be missing or empty.
        frames: number of photographs of each of the three cameras, `step` m apart.
        width: image width, pixels (paper: 1920).
        height: image height, pixels (paper: 1300).
        iso_std: standard deviation of the ISO (paper: 2 and 4); 0: ISO-Const; unless `sensor`.
        seed: seed of the town, the ISO and the points.
        supersample: samples per pixel along each axis; by default 2, or 8 if `matte`.
        points: number of sampled seed points; points with one observation are dropped.
        hold_out: every n-th frame may be held out and gives no points; 0: all frames do.
        sensor: the image formation of the cameras.
        layout: `town` adds an underpass and draws the sun; `long` has no end.
        matte: whether surfaces have no gloss, so that every view sees the same radiance.
        render: another renderer; yields radiance (half or single) and camera z of every view.
        report: receives lines on the progress.

    UserError: a parameter is not valid, or `out` is not free. OSError names `out`.
    """
    prefix = "--" if sensor is None else "--sensor."
    out, sensor = Path(out), sensor or Sensor(iso_std=iso_std)
    check_sensor(sensor, prefix)
    supersample = (8 if matte else 2) if supersample is None else supersample
    options = {
        **{"seed": seed, "frames": frames, "width": width, "height": height},
        **{"supersample": supersample, "step_m": step, "layout": layout, "matte": matte},
        **{"hold_out": hold_out, "points_sampled": points, "iso_std": sensor.iso_std},
    }
    _check(out, options)
    town = build_town(seed, layout, frames * step, matte=matte)
    views, frame = _views(frames, width, height, step)
    shots = draw_shots(sensor, frames, len(MOUNTS), seed)
    with atomic_folder(out) as temporary, naming(out):
        report(f"rendering {len(views.names)} views of a street with {town.size} primitives")
        rendered = render(views) if render else _render_all(town, views, supersample)
        photographs, depths = _photograph(temporary, views, rendered, shots, sensor, seed, report)
        held = (frame % hold_out == 0) if hold_out and frames > 1 else np.zeros(len(frame), bool)
        xyz, rgb = sample_seeds(views, photographs, depths, ~held, points, seed)
        observed = write_seeds(temporary / "sparse" / "0", views, xyz, rgb, depths)
        write_true_exposures(temporary, views.names, shots)
        card = {
            **{"format": FORMAT, **options, **observed, "iso_reference": ISO_REFERENCE},
            **{"K": views.K.tolist(), "solids": town.size, "sensor": asdict(sensor)},
            **{"cameras": {k: asdict(m) for k, m in MOUNTS.items()}, "light": asdict(town.light)},
        }
        (temporary / "dataset.json").write_text(json.dumps(card, indent=2) + "\n")
        _require_free(out)
    report(f"wrote {out}: {len(views.names)} photographs, {observed['points']} points")
    return out


def _views(frames: int, width: int, height: int, step: float):
    """Return the cameras of a drive, and the frame of each view."""
    places = drive(frames, step=step)
    shots = [(camera, f) for camera in sorted(MOUNTS) for f in range(frames)]
    names = [f"{camera}/{f:06d}.png" for camera, f in shots]
    viewmats = np.stack([camera_viewmat(MOUNTS[camera], places[f]) for camera, f in shots])
    views = DriveViews(names, viewmats, intrinsics(width, height), width, height)
    return views, np.array([f for _, f in shots])


def _photograph(
    root: Path,
    views: DriveViews,
    rendered: Iterator[tuple[np.ndarray, np.ndarray]],
    shots: Shots,
    sensor: Sensor,
    seed: int,
    report: Callable[[str], None],
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Write all views; return photographs and depths."""
    photographs, depths = [], []
    for row, (linear, depth) in enumerate(rendered):
        rng, pipeline = generator(seed, SceneStream.PHOTOGRAPH, row), shots.sensor(sensor, row)
        e, balance = shots.exposures[row], shots.balance[row]
        shot = photograph(linear, e, pipeline, balance=balance, rng=rng)
        reference = photograph(linear, 1.0, Sensor(curve=sensor.curve))
        sky = np.where(np.isinf(depth), np.uint8(255), np.uint8(0))
        pictures = {"images": shot, "reference": reference, "truth/sky_masks": sky}
        for folder, pixels in pictures.items():
            path = root / folder / views.names[row]
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(pixels).save(path, compress_level=4)
        path = (root / "truth" / "linear" / views.names[row]).with_suffix(".exr")
        path.parent.mkdir(parents=True, exist_ok=True)
        channels = {c: np.ascontiguousarray(linear[..., i]) for i, c in enumerate("RGB")}
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        with OpenEXR.File(header, channels | {"Z": depth.astype(np.float32)}) as file:
            file.write(str(path))
        photographs.append(shot)
        depths.append(depth)
        if (row + 1) % 10 == 0:
            report(f"rendered {row + 1} of {len(views.names)} views")
    return photographs, depths


def _check(out: Path, options: dict[str, Any]) -> None:
    frames, width, height, samples, step = (
        options[name] for name in ("frames", "width", "height", "supersample", "step_m")
    )
    if frames < 1 or width < 16 or height < 16 or samples < 1:
        why = f"{frames} frames of {width}x{height} pixels with {samples} samples along each axis "
        why += "cannot be rendered."
        raise UserError(why, fix="use at least 1 frame, 16x16 pixels and 1 sample")
    if options["seed"] < 0 or options["points_sampled"] < 1:
        why = f"seed {options['seed']} and {options['points_sampled']} seed points cannot be used."
        raise UserError(why, fix="use a seed of 0 or more, and at least 1 point")
    _require_free(out)
    length = (frames - 1) * step
    if options["layout"] != "long" and length > STREET_END:
        why = f"{frames} frames with a step of {step:g} m need {length:.0f} m, but the street has "
        why += f"{STREET_END:.0f} m."
        fix = "use fewer frames, or --layout long, which has as many streets as the drive needs"
        raise UserError(why, fix=fix)


def _require_free(out: Path) -> None:
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise UserError(f"{out} exists and is not an empty folder.", fix="name another folder")


def _render_all(
    town: Town, views: DriveViews, supersample: int
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield (linear as half floats, depth) of every view; two views are rendered at a time."""
    tracer = Tracer(town)

    def one(viewmat: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        linear, depth = tracer.render(viewmat, views.K, views.width, views.height, supersample)
        return linear.astype(np.float16), depth

    yield one(views.viewmats[0])  # compile before the threads start
    with ThreadPoolExecutor(2) as pool:
        yield from pool.map(one, views.viewmats[1:])
