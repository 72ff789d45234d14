"""How much room the views of a run need, estimated on the host from above.

In numpy: counting exactly would be one more program to compile for every image size.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from p2gs_jax.config import RenderConfig
from p2gs_jax.render.blocks import whole_blocks
from p2gs_jax.render.capacity import Room, bucket
from p2gs_jax.render.cutoff import SMALLEST_CUTOFF
from p2gs_jax.render.project import LOG_SCALE_RANGE, TANGENT_LIMIT
from p2gs_jax.render.visible import SLACK
from p2gs_jax.types import Gaussians

# Of the first of these many views, evenly spread.
SAMPLED_VIEWS = 32
# Entries: splats widen before they settle, and share their places as they grow in number; visible:
# views between the sampled ones.
ENTRIES_MARGIN, VISIBLE_MARGIN = 1.5, 1.1
ENTRIES_PER_GAUSSIAN, FEWEST_ENTRIES = 4, 16_384


class HostCamera(NamedTuple):
    """A camera on the host: world-to-camera, intrinsics in pixels, size in pixels."""

    viewmat: Float[np.ndarray, "4 4"]
    K: Float[np.ndarray, "3 3"]
    width: int
    height: int


class HostGaussians(NamedTuple):
    """What decides about extents, on the host: live Gaussians only.

    Attributes:
        means: centres, scene units.
        axes: principal axes times standard deviations, as columns.
        reach: log(opacity / cutoff), positive.
    """

    means: Float[np.ndarray, "n 3"]
    axes: Float[np.ndarray, "n 3 3"]
    reach: Float[np.ndarray, " n"]

    @classmethod
    def of(
        cls, gaussians: Gaussians, alive: Bool[np.ndarray, " n"], cfg: RenderConfig
    ) -> HostGaussians:
        """Return it for Gaussians given as numpy arrays."""
        smallest = cfg.alpha_cutoff
        if cfg.cutoff_rule == "radiance":
            smallest = min(smallest, SMALLEST_CUTOFF)
        reach = -np.logaddexp(0, -gaussians.opacity_logits) - np.log(smallest)
        kept = alive & (reach > 0)
        q = gaussians.quats[kept]
        w, x, y, z = (q / np.maximum(np.linalg.norm(q, axis=1, keepdims=True), 1e-12)).T
        rotation = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        ).transpose(2, 0, 1)
        scales = np.exp(np.clip(gaussians.log_scales[kept], *LOG_SCALE_RANGE))
        return cls(np.asarray(gaussians.means)[kept], rotation * scales[:, None], reach[kept])


def count_view(gaussians: HostGaussians, camera: HostCamera, cfg: RenderConfig) -> tuple[int, int]:
    """Return (tile-list entries, visible Gaussians) that a view needs at most, up to rounding.

    Entries are the tiles of all bounding boxes; visible is what `p2gs_jax.render.visible.in_view`
    lets through, which bounds a Gaussian by a ball as wide as its widest axis.

    Args:
        gaussians: live ones.
        camera: the view.
        cfg: near plane, blur, tile size.
    """
    R = camera.viewmat[:3, :3]
    at = gaussians.means @ R.T + camera.viewmat[:3, 3]
    front = at[:, 2] > cfg.near
    x, y, z = at[front].T
    axes, reach = R @ gaussians.axes[front], gaussians.reach[front]
    widest2 = np.max(np.sum(axes * axes, 1), -1, initial=0.0)
    tiles, inside, boxed = np.ones(len(z)), np.ones(len(z), bool), np.ones(len(z), bool)
    for i, (along, size) in enumerate(((x, camera.width), (y, camera.height))):
        f, c = camera.K[i, i], camera.K[i, 2]
        limit = TANGENT_LIMIT * size / (2 * f)
        slant = np.clip(along / z, -limit, limit)
        middle = f * along / z + c
        ball2 = widest2 * (f / z) ** 2 * (1 + slant * slant)
        own2 = np.sum((axes[:, i] - slant[:, None] * axes[:, 2]) ** 2, -1) * (f / z) ** 2
        wide, tight = (np.sqrt(2 * reach * (v + cfg.blur)) for v in (ball2, own2))
        inside &= (middle + wide + SLACK >= 0) & (middle - wide - SLACK <= size)
        boxed &= (middle + tight >= 0) & (middle - tight <= size)
        first, last = (
            np.floor(np.clip(edge, 0, size - 1) / cfg.tile[i])
            for edge in (middle - tight, middle + tight)
        )
        tiles *= last - first + 1
    return int(tiles[boxed].sum()), int(inside.sum())


def room_for(
    gaussians: Gaussians,
    alive: Bool[np.ndarray, " n"],
    cameras: Sequence[HostCamera],
    limit: int,
    cfg: RenderConfig,
) -> Room:
    """Return room for all views of one image size, to the end of a run.

    Args:
        gaussians: the population, as numpy arrays.
        alive: slots in use.
        cameras: the views; some of them are counted.
        limit: the largest population to come; the share that a view shows is taken to stay.
        cfg: see `count_view`.
    """
    picks = np.linspace(0, len(cameras) - 1, min(SAMPLED_VIEWS, len(cameras))).round().astype(int)
    live = HostGaussians.of(gaussians, alive, cfg)
    counts = [count_view(live, cameras[i], cfg) for i in picks]
    entries, visible = (max(c[k] for c in counts) for k in (0, 1))
    growth = max(max(limit, 1) / max(int(alive.sum()), 1), 1.0)
    wanted = int(visible * VISIBLE_MARGIN * growth)
    lists = int(ENTRIES_MARGIN * entries * growth**0.5)
    return Room(
        bucket(max(lists, ENTRIES_PER_GAUSSIAN * wanted, FEWEST_ENTRIES)),
        min(whole_blocks(wanted), whole_blocks(max(limit, len(alive)))),
    )
