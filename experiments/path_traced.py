"""A street that Mitsuba renders, because our towns come from a tracer of ours.

pip install mitsuba==3.5.2 && python experiments/path_traced.py OUT [--matte]

Mitsuba path-traces 30 frames of the paper's three cameras past textured houses, boxes and balls,
some of which are glossy, with 64 samples a pixel and three bounces. It needs LLVM up to 15
(DRJIT_LIBLLVM_PATH). OUT gets one scene per spread of ISO, in the format of `p2gs-jax synth`:

    p2gs-jax calibrate OUT/iso4 --out CAL --compare-with OUT/iso4/truth/exposures.csv
    p2gs-jax fit OUT/iso4 --out RUN --steps 1000 --reference OUT/iso4/reference
"""

from __future__ import annotations

import argparse
import importlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from p2gs_jax.synth.colmap_files import DriveViews
from p2gs_jax.synth.rig import FOV_DEGREES
from p2gs_jax.synth.write import write_street

SAMPLES, BOUNCES, ROUGHNESS = 64, 3, 0.3
MEDIAN = 0.18  # of the radiance of the first view


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--matte", action="store_true", help="without gloss")
    args = parser.parse_args()
    mi: Any = importlib.import_module("mitsuba")
    mi.set_variant("llvm_ad_rgb")
    scene = mi.load_dict(street(mi, np.random.default_rng(5), matte=args.matte))
    rendered: list[tuple[np.ndarray, np.ndarray]] = []

    def render(views: DriveViews) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        for row in range(len(rendered), len(views.names)):
            rendered.append(view(mi, scene, views, row))
            print(f"{row + 1} of {len(views.names)} views", flush=True)
        gain = MEDIAN / np.median(rendered[0][0])
        return ((linear * gain, depth) for linear, depth in rendered)

    options = {"frames": 30, "seed": 1, "points": 12_000, "matte": args.matte, "render": render}
    for std in (0.0, 2.0, 4.0):
        write_street(args.out / f"iso{std:g}", iso_std=std, **options)


def view(mi: Any, scene: Any, views: DriveViews, row: int) -> tuple[np.ndarray, np.ndarray]:
    """Return radiance [h w 3] and camera z [h w] of a view; inf: the sky."""
    (h, w), viewmat = (views.height, views.width), views.viewmats[row]
    R, eye = viewmat[:3, :3], -viewmat[:3, :3].T @ viewmat[:3, 3]
    to_world = mi.ScalarTransform4f.look_at(list(eye), list(eye + R[2]), list(-R[1]))
    film = {"type": "hdrfilm", "width": w, "height": h, "rfilter": {"type": "box"}}
    sensor = {"type": "perspective", "to_world": to_world, "fov": FOV_DEGREES, "film": film}
    image = np.array(mi.render(scene, sensor=mi.load_dict(sensor), spp=SAMPLES, seed=row))
    y, x = np.mgrid[:h, :w] + 0.5
    rays = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3) @ np.linalg.inv(views.K).T @ R
    length = np.linalg.norm(rays, axis=1)
    towards = mi.Vector3f(*(mi.Float(v) for v in (rays / length[:, None]).T.astype(np.float32)))
    hit = scene.ray_intersect(mi.Ray3f(mi.Point3f(*map(float, eye)), towards))
    depth = np.where(np.array(hit.is_valid()), np.array(hit.t) / length, np.inf)
    return image[..., :3], depth.reshape(h, w)


def street(mi: Any, rng: np.random.Generator, *, matte: bool) -> dict[str, Any]:
    """Return a street along +x with a sun and a sky; metres, z up."""
    T = mi.ScalarTransform4f

    def surface(size: int, color: np.ndarray, *, house: bool = False, gloss: bool = True) -> dict:
        bitmap = mi.Bitmap(texture(rng, size, color, house=house).astype(np.float32))
        picture = {"type": "bitmap", "bitmap": bitmap, "raw": True}
        if matte or not gloss:
            return {"type": "twosided", "of": {"type": "diffuse", "reflectance": picture}}
        lacquer = {"type": "roughplastic", "diffuse_reflectance": picture, "alpha": ROUGHNESS}
        return {"type": "twosided", "of": lacquer}

    def paint() -> np.ndarray:
        color = rng.uniform(0.25, 0.85, 3)
        return (color + color.mean()) / 2

    sun = {"type": "rgb", "value": [3.2, 2.9, 2.4]}
    found: dict[str, Any] = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": BOUNCES + 1},
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.5, 0.65, 0.9]}},
        "sun": {"type": "directional", "direction": [0.35, 0.5, -1.0], "irradiance": sun},
        "ground": {
            "type": "rectangle",
            "to_world": T.translate([30, 0, 0]).scale([60, 12, 1]),
            "bsdf": surface(2048, np.array([0.45, 0.44, 0.42]), gloss=False),
        },
    }
    x = -12.0
    while x < 85:
        for side in (-1, 1):
            long, high, y = rng.uniform([5, 4, 6.5], [8, 11, 7.7])
            box = T.translate([x + long / 2, side * (y + 2), high / 2])
            box = box.scale([long / 2, 2, high / 2])
            wall = surface(512, paint(), house=True, gloss=rng.random() < 0.4)
            found[f"house {len(found)}"] = {"type": "cube", "to_world": box, "bsdf": wall}
        x += rng.uniform(5.5, 8.5)
    for k in range(36):
        at = [rng.uniform(2, 70), rng.choice([-1, 1]) * rng.uniform(4, 5.2)]
        size = rng.uniform([0.6, 0.4, 0.35], [1.9, 0.9, 0.9])
        if k % 3:
            box = T.translate([*at, size[2]]).rotate([0, 0, 1], rng.uniform(-12, 12))
            shape = {"type": "cube", "to_world": box.scale(list(size))}
        else:
            shape = {"type": "sphere", "center": [*at, size[1]], "radius": size[1]}
        found[f"thing {k}"] = {**shape, "bsdf": surface(256, paint())}
    return found


def texture(rng: np.random.Generator, size: int, color: np.ndarray, *, house: bool) -> np.ndarray:
    """Return reflectances [size size 3] with detail of all sizes, and bricks and windows."""
    value = 0.15 * rng.normal(size=(size, size))
    for octave in range(1, 8):
        coarse = rng.normal(size=(2**octave, 2**octave))
        value += cv2.resize(coarse, (size, size), interpolation=cv2.INTER_CUBIC) * 0.75**octave
    value = 0.3 + 0.7 * (value - value.min()) / np.ptp(value)
    if house:
        row, column = np.mgrid[:size, :size]
        mortar = (row % 16 < 2) | ((column + row // 16 % 2 * 20) % 40 < 3)
        window = (row % 170 < 85) & (column % 128 < 60)
        value *= np.where(window, 0.18, np.where(mortar, 0.55, 1.0))
    return value[..., None] * color


if __name__ == "__main__":
    main()
