"""Rays against a town: first hits, shadows, and ambient occlusion.

Loops over short lists of primitives, vectorised over some thousand rays. Arrays are channel-first:
points and directions are [3 R].
"""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from p2gs_jax.synth.textures import as_column
from p2gs_jax.synth.town import Material, Town

_UNROLL = 4
_REACH = (0.35, 1.4)  # distances along the normal where the distance field is read, m
_WEIGHT = (0.30, 0.30)  # how much of the ambient light each can take
_CANYON_REACH, _CANYON_WEIGHT = 5.0, 0.28  # the same for the houses alone


def nearest_hit(
    town: Town, o: Float[Array, "3 1"], d: Float[Array, "3 r"], among: Bool[Array, " p"]
) -> tuple[Float[Array, " r"], Int[Array, " r"]]:
    """Return t of the nearest hit (inf: sky) and the primitive's row; P is the ground."""
    ground = jnp.where(d[2] < -1e-7, -o[2] / jnp.where(d[2] < -1e-7, d[2], -1.0), jnp.inf)
    start = (ground, jnp.full(d.shape[1], town.size, jnp.int32))

    def closer(best, entry: Array, leave: Array, row: Array):
        t, index = best
        hit = (entry <= leave) & (entry > 1e-4) & (entry < t)
        return jnp.where(hit, entry, t), jnp.where(hit, row, index)

    return _intersect(town, o, d, among, start, closer)


def in_shadow(
    town: Town, o: Float[Array, "3 r"], to_sun: np.ndarray, lower: Array, upper: Array
) -> Float[Array, " r"]:
    """Return 1 where a primitive lies between points o and the sun, a unit vector.

    Primitives whose shadow misses the bounds of the points are skipped.
    """
    side = np.cross(to_sun, (0.0, 0.0, 1.0))
    axes = np.stack([side, np.cross(side, to_sun)])  # the plane the sun projects on
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)

    def extent(lo, hi):
        """Interval that a box covers along each of the two axes."""
        center, half = (lo + hi) / 2 @ axes.T, (hi - lo) / 2 @ np.abs(axes).T
        return center - half, center + half

    a0, a1 = extent(town.lo, town.hi)
    b0, b1 = extent(jnp.where(lower < upper, lower, 0.0), jnp.where(lower < upper, upper, 0.0))
    among = jnp.all((a1 > b0 - 0.05) & (a0 < b1 + 0.05), axis=1)
    among &= town.hi[:, 2] > lower[2]

    def blocked(shadow, entry: Array, leave: Array, row: Array):
        return jnp.where((entry <= leave) & (leave > 1e-4), 1.0, shadow)

    return _intersect(town, o, as_column(to_sun), among, jnp.zeros(o.shape[1]), blocked)


def _intersect(town: Town, o: Array, d: Array, among: Array, carry, update: Callable):
    """Run `update(carry, entry, leave, row)` over primitives; entry > leave is a miss."""
    inverse = 1.0 / jnp.where(jnp.abs(d) < 1e-9, 1e-9, d)

    def box(carry, row: Array, lo: Array, hi: Array):
        a = [(lo[i] - o[i]) * inverse[i] for i in range(3)]
        b = [(hi[i] - o[i]) * inverse[i] for i in range(3)]
        near, far = [list(map(f, a, b)) for f in (jnp.minimum, jnp.maximum)]
        return update(carry, _fold(jnp.maximum, near), _fold(jnp.minimum, far), row)

    def tapered(carry, row: Array, planes: Array):
        entry, leave = jnp.full(1, -jnp.inf), jnp.full(1, jnp.inf)
        for k in range(6):
            n = planes[k]
            speed = n[0] * d[0] + n[1] * d[1] + n[2] * d[2]
            gap = n[3] - (n[0] * o[0] + n[1] * o[1] + n[2] * o[2])
            t = gap / jnp.where(jnp.abs(speed) < 1e-9, 1e-9, speed)
            entry = jnp.where(speed < 0, jnp.maximum(entry, t), entry)
            leave = jnp.where(speed >= 0, jnp.minimum(leave, t), leave)
        return update(carry, entry, leave, row)

    def ellipsoid(carry, row: Array, lo: Array, hi: Array):
        c, r = (lo + hi) / 2, 2.0 / (hi - lo)
        u = [(o[i] - c[i]) * r[i] for i in range(3)]
        v = [d[i] * r[i] for i in range(3)]
        vv = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
        uv = u[0] * v[0] + u[1] * v[1] + u[2] * v[2]
        root = uv * uv - vv * (u[0] * u[0] + u[1] * u[1] + u[2] * u[2] - 1.0)
        half = jnp.sqrt(jnp.maximum(root, 0.0))
        entry = jnp.where(root > 0, (-uv - half) / vv, jnp.inf)
        leave = jnp.where(root > 0, (-uv + half) / vv, -jnp.inf)
        return update(carry, entry, leave, row)

    return _over(town, among, carry, box, tapered, ellipsoid)


def open_sky(
    town: Town, p: Float[Array, "3 r"], n: Float[Array, "3 r"], lower: Array, upper: Array
) -> Float[Array, " r"]:
    """Return how much ambient light reaches points, 0.12 to 1, from the distance field along n.

    `n` are unit normals, `lower` and `upper` the bounds of the points.
    """
    probes = [p + reach * n for reach in _REACH]
    far = p + _CANYON_REACH * n

    def within(distance: float) -> Array:
        return jnp.all((town.hi > lower - distance) & (town.lo < upper + distance), axis=1)

    def to_box(q: Array, lo: Array, hi: Array) -> Array:
        gaps = [jnp.maximum(jnp.maximum(lo[i] - q[i], q[i] - hi[i]), 0.0) for i in range(3)]
        return gaps[0] ** 2 + gaps[1] ** 2 + gaps[2] ** 2

    def to_taper(q: Array, planes: Array) -> Array:
        inside = [
            planes[k, 0] * q[0] + planes[k, 1] * q[1] + planes[k, 2] * q[2] - planes[k, 3]
            for k in range(6)
        ]
        return jnp.maximum(_fold(jnp.maximum, inside), 0.0) ** 2

    def to_ellipsoid(q: Array, lo: Array, hi: Array) -> Array:
        c, h = (lo + hi) / 2, (hi - lo) / 2
        k = jnp.sqrt(sum(((q[i] - c[i]) / h[i]) ** 2 for i in range(3)))
        return (jnp.maximum(k - 1.0, 0.0) * (h[0] + h[1] + h[2]) / 3.0) ** 2

    def nearer(distance: Callable) -> Callable:
        def body(best, row: Array, *item: Array):
            return tuple(
                jnp.minimum(b, distance(q, *item)) for b, q in zip(best, probes, strict=True)
            )

        return body

    best = tuple(jnp.maximum(q[2], 0.0) ** 2 for q in probes)
    bodies = map(nearer, (to_box, to_taper, to_ellipsoid))
    best = _over(town, within(2 * _REACH[-1]), best, *bodies)
    houses = within(2 * _CANYON_REACH) & (town.material == Material.FACADE)

    def nearer_house(best, row: Array, lo: Array, hi: Array):
        return jnp.minimum(best, to_box(far, lo, hi))

    canyon = _over(town, houses, jnp.maximum(far[2], 0.0) ** 2, nearer_house)
    light = 1.0 - _CANYON_WEIGHT * (1.0 - jnp.minimum(jnp.sqrt(canyon) / _CANYON_REACH, 1.0))
    for squared, reach, weight in zip(best, _REACH, _WEIGHT, strict=True):
        light = light - weight * (1.0 - jnp.minimum(jnp.sqrt(squared) / reach, 1.0))
    return light


def _over(town: Town, among: Array, carry, box: Callable, tapered=None, ellipsoid=None):
    """Fold the bodies over the primitives in `among`: body(carry, row, *geometry) -> carry."""
    first_blob = town.n_boxes + town.n_tapered
    nowhere = np.full((_UNROLL, 3), 1e9, np.float32)
    shut = np.tile(np.array([[0, 0, 1, -1e9], [0, 0, -1, -1e9]], np.float32), (_UNROLL, 3, 1))
    corners = (np.concatenate([town.lo, nowhere]), np.concatenate([town.hi, 1.5 * nowhere]))
    kinds = (
        (box, 0, town.n_boxes, corners, 0),
        (tapered, town.n_boxes, first_blob, (np.concatenate([town.planes, shut]),), town.n_boxes),
        (ellipsoid, first_blob, town.size, corners, 0),
    )
    for body, start, stop, tables, base in kinds:
        if body is None:
            continue
        inside = among[start:stop]
        order = start + jnp.argsort(~inside, stable=True).astype(jnp.int32)
        count = jnp.sum(inside)
        pad = base + tables[0].shape[0] - _UNROLL  # rows that nothing hits
        order = jnp.where(jnp.arange(stop - start) < count, order, pad)
        order = jnp.concatenate([order, jnp.full(_UNROLL, pad, jnp.int32)])
        tables = tuple(map(jnp.asarray, tables))

        def several(k, carry, body=body, order=order, tables=tables, base=base):
            for j in range(_UNROLL):
                row = order[k * _UNROLL + j]
                carry = body(carry, row, *(table[row - base] for table in tables))
            return carry

        carry = lax.fori_loop(0, (count + _UNROLL - 1) // _UNROLL, several, carry)
    return carry


def _fold(function: Callable, values) -> Array:
    first, *rest = values
    for value in rest:
        first = function(first, value)
    return first
