"""Ray caster: linear HDR radiance and depth of a town, on the CPU through XLA.

The image is cut into tiles. Each tile has short lists of the primitives that its rays can hit, that
can shade its points, and that are near them. A sample finds its nearest primitive and gets its
material from `paint`. Its light comes from the sun (one shadow ray), the sky and the ground. This
ambient light is occluded by primitives within 5 m, through the distance field of the town at three
points along the normal, which is smooth and equal in all views. Radiance is averaged over the pixel
in linear space.

Arrays are channel-first: points and directions are [3 R]. Loops over short lists of primitives are
vectorised over some thousand rays.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Float32, Int

from p2gs_jax.synth.paint import paint, sky
from p2gs_jax.synth.textures import Surface, as_column
from p2gs_jax.synth.town import FACADE_LINE, UNDERPASS_HEIGHT, Material, Town

_TILE = 32  # pixels: a tile's rays stay in the second-level cache and share a list of primitives
_OFFSET = 4e-3  # shadow rays start this far off the surface, m
_DARKEST, _DAYLIGHT_REACH = 0.05, 2.5  # share of light deep in an underpass; decay, m
_AMBIENT_UP = (0.27, 0.325, 0.43)  # radiance of the sky as ambient light
_UNROLL = 4  # primitives per iteration of a loop
_REACH = (0.35, 1.4)  # distances along the normal where the distance field is read, m
_WEIGHT = (0.30, 0.30)  # largest share of the ambient light that each removes
_CANYON_REACH, _CANYON_WEIGHT = 5.0, 0.28  # the same for the houses alone


class Tracer:
    """Renders one town; compiled once per image size; safe to use from several threads at once."""

    def __init__(self, town: Town):
        """Keep the town; nothing is compiled yet."""
        self.town = town
        # Small jobs mostly compile: without LLVM's slowest passes for two thirds of the time.
        self._render = jax.jit(
            self._render_tiles,
            static_argnums=(2, 3, 4),
            compiler_options={"xla_llvm_disable_expensive_passes": True},
        )

    def render(
        self,
        viewmat: Float[np.ndarray, "4 4"],
        K: Float[np.ndarray, "3 3"],
        width: int,
        height: int,
        supersample: int = 2,
    ) -> tuple[Float32[np.ndarray, "h w 3"], Float32[np.ndarray, "h w"]]:
        """Return linear radiance, and camera z at the pixel centres (inf: sky), m.

        `viewmat` is world-to-camera, OpenCV axes; K is in pixels, centres at +0.5; a pixel is the
        mean of `supersample` samples along each axis.
        """
        cameras = (jnp.asarray(viewmat, jnp.float32), jnp.asarray(K, jnp.float32))
        linear, depth = self._render(*cameras, width, height, supersample)
        return np.asarray(linear), np.asarray(depth)

    def _render_tiles(
        self, viewmat: Array, K: Array, width: int, height: int, supersample: int
    ) -> tuple[Array, Array]:
        town, R = self.town, viewmat[:3, :3]
        origin = -R.T @ viewmat[:3, 3]
        lower, upper = _screen_boxes(town, viewmat, K)
        across, down = -(-width // _TILE), -(-height // _TILE)
        steps = np.append((np.arange(supersample) + 0.5) / supersample, 0.5)
        grid = np.stack(np.meshgrid(steps[:-1], steps[:-1]), -1).reshape(-1, 2)
        offsets = np.concatenate([grid, [[0.5, 0.5]]])  # the last ray gives the depth
        rows, cols = np.divmod(np.arange(_TILE**2), _TILE)
        xy = np.stack([cols, rows])[:, None] + offsets.T[:, :, None]  # [2 S+1 pixels]
        xy = jnp.asarray(xy.reshape(2, -1), jnp.float32)

        def tile(corner: Array) -> tuple[Array, Array]:
            x, y = xy[0] + corner[0], xy[1] + corner[1]
            camera = jnp.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], jnp.ones_like(x)])
            direction = R.T @ camera  # camera z = t along these
            seen = jnp.all((upper > corner) & (lower < corner + _TILE), axis=1)
            t, index = nearest_hit(town, origin[:, None], direction, seen)
            samples = supersample**2 * _TILE**2
            rays = direction[:, :samples], t[:samples], index[:samples]
            linear = _radiance(town, origin, *rays, 2 / max(supersample, 2) / K[0, 0])
            return linear.reshape(3, -1, _TILE, _TILE).mean(1), t[samples:].reshape(_TILE, _TILE)

        corners = _TILE * np.stack(np.meshgrid(np.arange(across), np.arange(down)), -1)
        linear, depth = lax.map(tile, jnp.asarray(corners.reshape(-1, 2), jnp.float32))
        linear = linear.reshape(down, across, 3, _TILE, _TILE).transpose(0, 3, 1, 4, 2)
        depth = depth.reshape(down, across, _TILE, _TILE).transpose(0, 2, 1, 3)
        linear = linear.reshape(down * _TILE, across * _TILE, 3)[:height, :width]
        return linear, depth.reshape(down * _TILE, across * _TILE)[:height, :width]


def _radiance(
    town: Town, origin: Array, direction: Array, t: Array, index: Array, detail_angle: Array
) -> Float[Array, "3 r"]:
    """Return the linear radiance that arrives at the origin [3] along rays [3 R].

    Directions are not normalised; `t` [R] is the hit on a ray (inf: sky), `index` [R] its row.
    Texture finer than `detail_angle` times camera z fades out.
    """
    hit = jnp.isfinite(t)
    p = origin[:, None] + jnp.where(hit, t, 1.0) * direction
    view = direction / jnp.sqrt(jnp.sum(direction**2, 0))
    surface = paint(town, p, view, index, jnp.where(hit, t, 1.0) * detail_angle)
    lit = _light(town, p, view, surface, hit)
    above = lax.cond(jnp.all(hit), jnp.zeros_like, lambda view: sky(town, view, clouds=True), view)
    return jnp.where(hit, lit, above)


def _light(town: Town, p: Array, view: Array, surface: Surface, hit: Array) -> Array:
    light = town.light
    direction = np.array(light.sun_direction) / np.linalg.norm(light.sun_direction)
    to_sun = as_column(direction)
    lower = jnp.min(jnp.where(hit, p, jnp.inf), axis=1)
    upper = jnp.max(jnp.where(hit, p, -jnp.inf), axis=1)
    n = surface.normal
    start = p + _OFFSET * n
    facing = jnp.maximum(jnp.sum(surface.shading_normal * to_sun, 0), 0.0)
    facing = jnp.where(jnp.sum(n * to_sun, 0) > 0, facing, 0.0)
    sun = facing * (1.0 - in_shadow(town, start, direction, lower, upper))
    up = surface.shading_normal[2]
    ambient = as_column(_AMBIENT_UP) * (0.56 + 0.44 * up)
    ambient = ambient + as_column(light.bounce) * (0.5 - 0.5 * up)
    ambient = ambient * open_sky(town, p, n, lower, upper)
    if town.underpass is not None:
        ambient = ambient * _daylight(p, town.underpass)
    diffuse = surface.albedo * (as_column(light.sun) * sun + ambient)
    # Glossy paint and glass: the sky and, below it, a nondescript street; a broad sun highlight.
    cosine = jnp.clip(-jnp.sum(view * n, 0), 0.0, 1.0)
    mirrored = view + 2.0 * cosine * n
    fresnel = surface.gloss * (0.06 + 0.94 * (1.0 - cosine) ** 5)
    street = as_column((0.13, 0.115, 0.10))
    blend = jnp.clip((mirrored[2] - 0.12) / 0.35, 0.0, 1.0)
    reflected = street + blend * (sky(town, mirrored, clouds=False) - street)
    lobe = jnp.maximum(jnp.sum(mirrored * to_sun, 0), 0.0) ** 80
    highlight = as_column(light.sun) * (6.0 * lobe * (sun > 0))
    return diffuse + fresnel * (reflected + highlight) + surface.emission


def _daylight(p: Float[Array, "3 r"], underpass: tuple[float, float]) -> Float[Array, " r"]:
    """Return the share of ambient light at points under a house, which falls from both ends."""
    inside = (jnp.abs(p[1]) < FACADE_LINE + 0.5) & (p[2] < UNDERPASS_HEIGHT + 0.01)
    depth = jnp.minimum(p[0] - underpass[0], underpass[1] - p[0])
    left = _DARKEST + (1 - _DARKEST) * jnp.exp(-jnp.maximum(depth, 0.0) / _DAYLIGHT_REACH)
    return jnp.where(inside, left, 1.0)


def _screen_boxes(town: Town, viewmat: Array, K: Array) -> tuple[Array, Array]:
    """Return bounds of every primitive, pixels, [P 2]; infinite if it may be beside the camera."""
    picks = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1]), -1).reshape(-1, 3)
    corners = np.where(picks[:, None, :] == 0, town.lo, town.hi)  # [8 P 3]
    local = corners @ viewmat[:3, :3].T + viewmat[:3, 3]
    z = local[..., 2]
    front = jnp.all(z > 0.05, axis=0)[:, None]
    behind = jnp.all(z <= 0.0, axis=0)[:, None]
    xy = local[..., :2] / jnp.maximum(z, 0.05)[..., None]
    xy = xy * jnp.stack([K[0, 0], K[1, 1]]) + K[:2, 2]
    lower = jnp.where(front, xy.min(0) - 0.5, -jnp.inf)
    upper = jnp.where(front, xy.max(0) + 0.5, jnp.inf)
    return jnp.where(behind, jnp.inf, lower), jnp.where(behind, -jnp.inf, upper)


def nearest_hit(
    town: Town, o: Float[Array, "3 1"], d: Float[Array, "3 r"], among: Bool[Array, " p"]
) -> tuple[Float[Array, " r"], Int[Array, " r"]]:
    """Return t of the nearest hit along o + t d (inf: sky), and its row (`town.size`: ground)."""
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
        """Return the interval that a box covers along each of the two axes."""
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
        return update(carry, reduce(jnp.maximum, near), reduce(jnp.minimum, far), row)

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
    """Return the share of ambient light at points, 0.12 to 1, from the distance field along n.

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
        return jnp.maximum(reduce(jnp.maximum, inside), 0.0) ** 2

    def to_ellipsoid(q: Array, lo: Array, hi: Array) -> Array:
        c, h = (lo + hi) / 2, (hi - lo) / 2
        k = jnp.sqrt(sum(((q[i] - c[i]) / h[i]) ** 2 for i in range(3)))
        return (jnp.maximum(k - 1.0, 0.0) * (h[0] + h[1] + h[2]) / 3.0) ** 2

    def nearer(distance: Callable) -> Callable:
        return lambda best, row, *item: tuple(
            jnp.minimum(b, distance(q, *item)) for b, q in zip(best, probes, strict=True)
        )

    best = tuple(jnp.maximum(q[2], 0.0) ** 2 for q in probes)
    bodies = map(nearer, (to_box, to_taper, to_ellipsoid))
    best = _over(town, within(2 * _REACH[-1]), best, *bodies)
    houses = within(2 * _CANYON_REACH) & (town.material == Material.FACADE)

    start = jnp.maximum(far[2], 0.0) ** 2
    canyon = _over(town, houses, start, lambda best, row, *c: jnp.minimum(best, to_box(far, *c)))
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
