"""Materials keep their means from every distance, and small pieces their light."""

import functools
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from p2gs_jax.synth.furnish import build_town
from p2gs_jax.synth.paint import paint
from p2gs_jax.synth.town import Builder, Light, Material, Vec3, pack
from p2gs_jax.synth.tracer import Tracer

SIDE = 192  # points along each axis of a face
FOOTPRINTS = (0.005, 0.02, 0.06, 0.2, 1.0)  # m
TO_SUN = np.array([-0.5, -0.5, 0.7], np.float32)[:, None] / np.sqrt(0.99)


class Face(NamedTuple):
    """A solid, the axis of its face (the low side, or the top), and the widest footprint, m."""

    lo: Vec3
    hi: Vec3
    material: Material
    color: Vec3
    axis: int = 1
    widest: float = 1.0
    options: Mapping[str, Any] = MappingProxyType({})


WALL: tuple[Vec3, Vec3] = (0.0, 9.0, 0.0), (60.0, 22.0, 14.5)
CAR: tuple[Vec3, Vec3] = (0.0, 0.0, 0.24), (4.3, 1.76, 0.92)
CABIN: tuple[Vec3, Vec3] = (0.35, 0.06, 0.9), (3.15, 1.7, 1.46)
BODY = {"style": 1.0, "top": (0.07, 4.23, 0.06, 1.7)}
GLASS = {"style": 1.0, "top": (0.63, 2.4, 0.22, 1.54)}
RED, STONE = (0.44, 0.17, 0.11), (0.62, 0.62, 0.6)
FACES = {
    "brick, windows": Face(*WALL, Material.FACADE, RED, options={"use": 0.1}),
    "brick, shops": Face(*WALL, Material.FACADE, RED, options={"use": 0.5}),
    "plaster": Face(*WALL, Material.FACADE, RED, options={"style": 1.0}),
    "stone": Face(*WALL, Material.FACADE, STONE, options={"style": 2.0, "use": 0.5}),
    "road": Face((-20.0, -5.6, -1.0), (100.0, 5.6, 0.0), Material.ROAD, RED, 2),
    "pavement": Face((0.0, 5.6, 0.0), (50.0, 25.0, 0.14), Material.PAVEMENT, STONE, 2),
    "plain": Face(*WALL, Material.PLAIN, STONE),
    "bark": Face((0.0, 0.0, 0.0), (20.0, 20.0, 20.0), Material.BARK, RED),
    "leaves": Face((0.0, 0.0, 0.0), (9.0, 9.0, 9.0), Material.FOLIAGE, RED, options={"kind": 2}),
    "tiles": Face(*WALL, Material.TILES, RED, options={"top": (0.0, 60.0, 15.0, 16.0)}),
    "awning": Face(*WALL, Material.AWNING, RED, 2),
    "sign": Face((0.0, 0.0, 2.2), (0.03, 0.72, 2.92), Material.SIGN, RED, 0, 0.06),
    "wheel": Face((0.0, 0.0, 0.0), (0.68, 0.24, 0.66), Material.WHEEL, RED, 1, 0.06),
    "car's side": Face(*CAR, Material.CAR_BODY, RED, 1, 0.06, BODY),
    "car's end": Face(*CAR, Material.CAR_BODY, RED, 0, 0.06, BODY),
    "side windows": Face(*CABIN, Material.CAR_GLASS, RED, 1, 0.06, GLASS),
    "windscreen": Face(*CABIN, Material.CAR_GLASS, RED, 0, 0.06, GLASS),
}


@pytest.fixture(scope="module")
def look():
    """Return a function of points, rows in the town, a ray direction and a footprint in m.

    It returns the face's mean albedo, gloss, and light from the sun and the sky, by channel.
    """
    build = Builder(np.random.default_rng(0))
    for face in sorted(FACES.values(), key=kind):
        build.add(face.lo, face.hi, face.material, face.color, **face.options)
    town = pack(build, 0, Light())

    @jax.jit
    def means(p, row, view, footprint):
        rays = jnp.ones(p.shape[1], jnp.int32)
        s = paint(town, p, view[:, None] * rays, row * rays, footprint * rays)
        facing = jnp.maximum(jnp.sum(s.shading_normal * TO_SUN, 0), 0.0)
        sky = 0.56 + 0.44 * s.shading_normal[2]
        parts = [s.albedo, s.gloss[None], s.albedo * facing, s.albedo * sky]
        return jnp.concatenate([jnp.mean(part, 1) for part in parts])

    return means


def kind(face: Face) -> int:
    """Return the kind of a face's solid; a town is sorted by it."""
    return 1 if "top" in face.options else face.options.get("kind", 0)


def points(face: Face) -> np.ndarray:
    """Return points all over a face, [3 R]; on all of an ellipsoid."""
    grid = np.stack(np.meshgrid(np.arange(SIDE), np.arange(SIDE)))
    u, v = (grid + np.random.default_rng(1).random(grid.shape)).reshape(2, -1) / SIDE
    (x0, y0, z0), (x1, y1, z1) = face.lo, face.hi
    if kind(face) == 2:
        up, around = 2 * v - 1, 2 * np.pi * u
        across = np.stack([np.cos(around), np.sin(around)]) * np.sqrt(1 - up**2)
        return (x0 + x1) / 2 + (x1 - x0) / 2 * np.stack([*across, up])
    if face.axis == 2:
        return np.stack([x0 + u * (x1 - x0), y0 + v * (y1 - y0), np.full_like(u, z1)])
    bottom, z = (x0, x1, y0, y1), z0 + v * (z1 - z0)
    top = face.options.get("top", bottom)
    x0, x1, y0, y1 = (a + v * (b - a) for a, b in zip(bottom, top, strict=True))
    return np.stack([x0, y0 + u * (y1 - y0), z] if face.axis == 0 else [x0 + u * (x1 - x0), y0, z])


@pytest.mark.parametrize("name", FACES)
def test_a_material_has_one_mean_from_every_distance(look, name):
    face = FACES[name]
    row = sorted(FACES.values(), key=kind).index(face)
    row = len(FACES) if face.material == Material.ROAD else row  # the ground
    view = np.eye(3, dtype=np.float32)[face.axis] * (-1.0 if face.axis == 2 else 1.0)
    p = points(face).astype(np.float32)
    near, *far = [look(p, row, view, f) for f in FOOTPRINTS if f <= face.widest]
    for means in far:
        np.testing.assert_allclose(means, near, rtol=0.01)


def test_eight_samples_a_pixel_show_a_piece_of_pavement_alike_from_four_times_as_far():
    build = Builder(np.random.default_rng(0))
    lo, hi = (-30.0, 6.0, 0.0), (30.0, 66.0, 0.14)
    build.add(lo, hi, Material.PAVEMENT, STONE)
    build.add((900.0,) * 3, (901.0,) * 3, Material.PLAIN, STONE, top=(900.0, 901.0) * 2)
    tracer = Tracer(pack(build, 0, Light(), 0.0))
    K = np.array([[32.0, 0, 16], [0, 32, 16], [0, 0, 1]])

    def from_above(height_m: float) -> np.ndarray:
        viewmat = np.diag([1.0, -1, -1, 1])
        viewmat[:3, 3] = [0.0, 36.0, 0.14 + height_m]
        return np.log2(tracer.render(viewmat, K, 32, 32, 8)[0])

    near, far = from_above(4.0), from_above(16.0)  # pixels are 0.125 and 0.5 m wide
    near = np.log2(np.exp2(near).reshape(8, 4, 8, 4, 3).mean((1, 3)))
    off = far[12:20, 12:20] - near
    # When slabs faded with the width of a pixel, these were 0.087 and -0.065 stop.
    assert off.std() < 0.02
    assert abs(off.mean()) < 0.005


def test_a_matte_town_is_the_town_without_gloss():
    matte, town = build_town(2, "town", matte=True), build_town(2, "town")
    np.testing.assert_array_equal(matte.lo, town.lo)
    assert matte.light == town.light
    middles, rows = jnp.asarray((town.lo + town.hi).T / 2), jnp.arange(town.size)
    gloss = [
        jax.jit(functools.partial(paint, t))(middles, -TO_SUN, rows, np.full(t.size, 0.01)).gloss
        for t in (matte, town)
    ]
    assert float(gloss[0].max()) == 0.0 < 0.5 < float(gloss[1].max())
