"""Ray caster: linear HDR radiance and depth of a town, on the CPU through XLA.

The image is cut into tiles. Each tile makes short lists of the primitives that its rays can meet,
that can shade its points, and that are near them; loops over these lists are vectorised over the
tile's few thousand rays. A sample finds its nearest primitive, is painted by `paint`, and is lit
by the sun (one shadow ray), the sky and the ground (ambient, occluded by what lies within 5 m: the
distance field of the town at three points along the normal, smooth and the same from every view).
Radiance is averaged over the pixel in linear space.

Arrays are channel-first: points and directions are [3 R].
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Float32, Int

from p2gs_jax.synth.intersect import in_shadow, nearest_hit, open_sky
from p2gs_jax.synth.paint import paint, sky
from p2gs_jax.synth.textures import Surface, as_column
from p2gs_jax.synth.town import FACADE_LINE, UNDERPASS_HEIGHT, Town

_TILE = 32  # pixels: a tile's rays stay in the second-level cache and share a list of primitives
_OFFSET = 4e-3  # shadow rays start this far off the surface, m
_DARKEST, _DAYLIGHT_REACH = 0.05, 2.5  # share of ambient light deep in an underpass; m
_AMBIENT_UP = (0.27, 0.325, 0.43)


class Tracer:
    """Renders one town; compiled once per image size.

    Thread-safe: views may be rendered from several threads at once.
    """

    def __init__(self, town: Town):
        """Keep the town; nothing is compiled yet."""
        self.town = town
        # Most of a small job is compilation; without LLVM's slowest passes it takes two thirds.
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
            linear = radiance(
                town, origin, direction[:, :samples], t[:samples], index[:samples], 1.0 / K[0, 0]
            )
            return linear.reshape(3, -1, _TILE, _TILE).mean(1), t[samples:].reshape(_TILE, _TILE)

        corners = _TILE * np.stack(np.meshgrid(np.arange(across), np.arange(down)), -1)
        linear, depth = lax.map(tile, jnp.asarray(corners.reshape(-1, 2), jnp.float32))
        linear = linear.reshape(down, across, 3, _TILE, _TILE).transpose(0, 3, 1, 4, 2)
        depth = depth.reshape(down, across, _TILE, _TILE).transpose(0, 2, 1, 3)
        linear = linear.reshape(down * _TILE, across * _TILE, 3)[:height, :width]
        return linear, depth.reshape(down * _TILE, across * _TILE)[:height, :width]


def radiance(
    town: Town,
    origin: Float[Array, " 3"],
    direction: Float[Array, "3 r"],
    t: Float[Array, " r"],
    index: Int[Array, " r"],
    pixel_angle: Array,
) -> Float[Array, "3 r"]:
    """Return the linear radiance that arrives along rays.

    Directions are not normalised; `t` is where a ray hits (inf: sky) and `index` what; a pixel is
    `pixel_angle` wide at unit camera z, and finer texture fades out.
    """
    hit = jnp.isfinite(t)
    p = origin[:, None] + jnp.where(hit, t, 1.0) * direction
    view = direction / jnp.sqrt(jnp.sum(direction**2, 0))
    surface = paint(town, p, view, index, jnp.where(hit, t, 1.0) * pixel_angle)
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
    ambient = as_column(_AMBIENT_UP) * (0.56 + 0.44 * up) + as_column(light.bounce) * (
        0.5 - 0.5 * up
    )
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
    seen = street + blend * (sky(town, mirrored, clouds=False) - street)
    lobe = jnp.maximum(jnp.sum(mirrored * to_sun, 0), 0.0) ** 80
    highlight = as_column(light.sun) * (6.0 * lobe * (sun > 0))
    return diffuse + fresnel * (seen + highlight) + surface.emission


def _daylight(p: Float[Array, "3 r"], underpass: tuple[float, float]) -> Float[Array, " r"]:
    """Return the share of ambient light that reaches points under a house: less from both ends."""
    inside = (jnp.abs(p[1]) < FACADE_LINE + 0.5) & (p[2] < UNDERPASS_HEIGHT + 0.01)
    depth = jnp.minimum(p[0] - underpass[0], underpass[1] - p[0])
    left = _DARKEST + (1 - _DARKEST) * jnp.exp(-jnp.maximum(depth, 0.0) / _DAYLIGHT_REACH)
    return jnp.where(inside, left, 1.0)


def _screen_boxes(town: Town, viewmat: Array, K: Array) -> tuple[Array, Array]:
    """Return bounds in pixels of every primitive, [P 2] each; everything if it may be beside us."""
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
