"""Upper estimates, made on the host, of the capacities that the views of a run need.

NumPy computes them, because an exact count would need one more compiled program per image size.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence

import jax
import numpy as np
from jaxtyping import Bool, Int

from p2gs_jax.config import RenderConfig
from p2gs_jax.core.numerics import evenly_spaced
from p2gs_jax.gaussians.posed import rotations
from p2gs_jax.render.capacity import TRAINING, TRAINING_VISIBLE, Capacity, bucket
from p2gs_jax.render.project import LOG_SCALE_RANGE, TANGENT_LIMIT, at_time, camera_of_each
from p2gs_jax.render.visible import in_view, whole_blocks
from p2gs_jax.train.inputs import TrainingViews
from p2gs_jax.types import Array, Camera, Gaussians

# Largest number of views that are counted per image size, evenly spaced.
SAMPLED_VIEWS = 32
# Tile lists of training are at least this long, whatever the count.
ENTRIES_PER_GAUSSIAN, FEWEST_ENTRIES = 4, 16_384


def count_view(
    gaussians: Gaussians,
    alive: Bool[np.ndarray, " n"],
    camera: Camera,
    cfg: RenderConfig,
    owner: Int[np.ndarray, " n"] | None = None,
) -> tuple[int, int]:
    """Return upper bounds, up to rounding, of a view's (tile-list entries, visible Gaussians).

    Entries are the tiles of all bounding boxes; visible Gaussians are those that `in_view` accepts.
    All arrays are on the host; `owner` is the row of the moving object of each Gaussian, or -1.
    """
    gaussians = at_time(gaussians, camera.objects)
    camera = camera_of_each(camera, owner)  # pyright: ignore[reportArgumentType]
    seen = in_view(gaussians, alive, camera, cfg)  # pyright: ignore[reportArgumentType]
    # Harmonics take most of a Gaussian's memory and are not needed here.
    bare = dataclasses.replace(gaussians, sh=gaussians.sh[:, :0])
    shown = jax.tree.map(lambda a: a[seen], bare)
    viewmat = np.asarray(camera.viewmat)
    R, t = viewmat[:3, :3], viewmat[:3, 3]
    if owner is None:
        local = shown.means @ R.T + t
    else:
        R, t = np.moveaxis(R[..., seen], -1, 0), t[..., seen].T
        local = np.einsum("nij,nj->ni", R, shown.means) + t
    x, y, z = local.T
    axes = R @ rotations(shown.quats).as_matrix()
    axes *= np.exp(np.clip(shown.log_scales, *LOG_SCALE_RANGE))[:, None]
    reach = -np.logaddexp(0, -shown.opacity_logits) - np.log(cfg.alpha_cutoff)
    tiles, boxed = np.ones(len(z)), np.ones(len(z), bool)
    for i, (along, size) in enumerate(((x, camera.width), (y, camera.height))):
        f, c = camera.K[i, i], camera.K[i, 2]
        limit = TANGENT_LIMIT * size / (2 * f)
        slant = np.clip(along / z, -limit, limit)
        deviation2 = np.sum((axes[:, i] - slant[:, None] * axes[:, 2]) ** 2, -1) * (f / z) ** 2
        radius = np.sqrt(2 * reach * (deviation2 + cfg.blur))
        low, high = f * along / z + c - radius, f * along / z + c + radius
        boxed &= (high >= 0) & (low <= size)
        first, last = (np.floor(np.clip(edge, 0, size - 1) / cfg.tile[i]) for edge in (low, high))
        tiles *= last - first + 1
    return int(tiles[boxed].sum()), int(seen.sum())


def capacity_for(
    gaussians: Gaussians,
    alive: Bool[np.ndarray, " n"],
    cameras: Sequence[Camera],
    limit: int,
    cfg: RenderConfig,
    owner: Int[np.ndarray, " n"] | None = None,
) -> Capacity:
    """Return a capacity that should suffice for all views of one image size until the run ends.

    At most SAMPLED_VIEWS cameras are counted. `limit` is the largest later population; the estimate
    assumes that a view's share of the Gaussians stays constant, and that denser ones are smaller.
    """
    picks = evenly_spaced(len(cameras), SAMPLED_VIEWS)
    counts = [count_view(gaussians, alive, cameras[i], cfg, owner) for i in picks]
    entries, visible = (max(c[k] for c in counts) for k in (0, 1))
    growth = max(max(limit, 1) / max(int(alive.sum()), 1), 1.0)
    wanted = int(visible * TRAINING_VISIBLE * growth)
    lists = int(TRAINING * entries * growth**0.5)
    return Capacity(
        bucket(max(lists, ENTRIES_PER_GAUSSIAN * wanted, FEWEST_ENTRIES)),
        min(whole_blocks(wanted), whole_blocks(limit)),
    )


Capacities = dict[str, Capacity]  # capacity of a view by the name of its image size


def size_name(size: tuple[int, int]) -> str:
    """Return the name of an image size: "WxH"."""
    return f"{size[0]}x{size[1]}"


def allocate(
    capacities: Mapping[str, Capacity],
    begun: Mapping[str, Capacity],
    views: TrainingViews,
    shrinks: Iterable[int],
    gaussians: Gaussians,
    alive: Bool[Array, " n"],
    limit: int,
    cfg: RenderConfig,
    owner: Int[Array, " n"] | None = None,
) -> Capacities:
    """Return capacities for all image sizes of the levels `shrinks`.

    Existing `capacities` stay. A capacity in `begun`, for which compilation has begun, is used
    if it suffices. `limit` is the largest later population; for `owner` see `count_view`.
    """
    found = dict(capacities)
    gaussians, host_alive = jax.tree.map(np.asarray, (gaussians, alive))
    host_owner = None if owner is None else np.asarray(owner)
    for shrink in shrinks:
        by_size: dict[str, list[Camera]] = {}
        for index in range(len(views)):
            camera = views.camera(index, shrink)
            by_size.setdefault(size_name((camera.width, camera.height)), []).append(camera)
        for name, cameras in by_size.items():
            if name not in found:
                capacity = capacity_for(gaussians, host_alive, cameras, limit, cfg, host_owner)
                earlier = begun.get(name, capacity)
                found[name] = earlier if earlier.holds(capacity) else capacity
    return _sharing_visible(found)


def grown(
    capacities: Mapping[str, Capacity], size: tuple[int, int], entries: int, visible: int
) -> Capacities:
    """Return capacities after an overflow in a view of this size that needed these counts."""
    name = size_name(size)
    return _sharing_visible({**capacities, name: capacities[name].grown(entries, visible)})


def _sharing_visible(capacities: Capacities) -> Capacities:
    """Return capacities with one `visible`, so that all sizes share the programs per Gaussian."""
    most = max((capacity.visible for capacity in capacities.values()), default=0)
    return {name: capacity._replace(visible=most) for name, capacity in capacities.items()}
