"""How much room the views of a run need, estimated on the host from above.

It is done in numpy: counting exactly would be one more program to compile for every image size.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import jax
import numpy as np
from jaxtyping import Bool, Int

from p2gs_jax.config import RenderConfig
from p2gs_jax.core.numerics import evenly_spaced
from p2gs_jax.gaussians.posed import rotations
from p2gs_jax.render.capacity import Room
from p2gs_jax.render.project import LOG_SCALE_RANGE, TANGENT_LIMIT, at_time, camera_of_each
from p2gs_jax.render.visible import in_view
from p2gs_jax.train.inputs import TrainingViews
from p2gs_jax.types import Array, Camera, Gaussians

# Views of one size that are counted, evenly spread.
SAMPLED_VIEWS = 32


def count_view(
    gaussians: Gaussians,
    alive: Bool[np.ndarray, " n"],
    camera: Camera,
    cfg: RenderConfig,
    owner: Int[np.ndarray, " n"] | None = None,
) -> tuple[int, int]:
    """Return (tile-list entries, visible Gaussians) that a view needs at most, up to rounding.

    Entries are the tiles of all bounding boxes, visible is the count of `in_view`. Everything is on
    the host; `owner` is the moving object that each Gaussian belongs to.
    """
    gaussians = at_time(gaussians, camera.objects)
    camera = camera_of_each(camera, owner)  # pyright: ignore[reportArgumentType]
    seen = in_view(gaussians, alive, camera, cfg)  # pyright: ignore[reportArgumentType]
    shown = jax.tree.map(lambda a: a[seen], gaussians)
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


def room_for(
    gaussians: Gaussians,
    alive: Bool[np.ndarray, " n"],
    cameras: Sequence[Camera],
    limit: int,
    cfg: RenderConfig,
    owner: Int[np.ndarray, " n"] | None = None,
) -> Room:
    """Return room for all views of one image size, to the end of a run.

    Some of the cameras are counted. `limit` is the largest population to come; the share of it that
    a view shows is taken to stay.
    """
    picks = evenly_spaced(len(cameras), SAMPLED_VIEWS)
    counts = [count_view(gaussians, alive, cameras[i], cfg, owner) for i in picks]
    entries, visible = (max(c[k] for c in counts) for k in (0, 1))
    growth = max(max(limit, 1) / max(int(alive.sum()), 1), 1.0)
    return Room.allocate(entries, visible, growth, limit)


Rooms = dict[str, Room]  # room of a view for every image size, by its name


def size_name(size: tuple[int, int]) -> str:
    """Return the name of an image size: "WxH"."""
    return f"{size[0]}x{size[1]}"


def cameras_by_size(views: TrainingViews, shrink: int) -> dict[tuple[int, int], list[Camera]]:
    """Return the cameras of a level by the size of their images."""
    cameras: dict[tuple[int, int], list[Camera]] = {}
    for index in range(len(views)):
        camera = views.camera(index, shrink)
        cameras.setdefault((camera.width, camera.height), []).append(camera)
    return cameras


def allocate(
    rooms: Mapping[str, Room],
    begun: Mapping[str, Room],
    views: TrainingViews,
    shrinks: Iterable[int],
    gaussians: Gaussians,
    alive: Bool[Array, " n"],
    limit: int,
    cfg: RenderConfig,
    owner: Int[Array, " n"] | None = None,
) -> Rooms:
    """Return rooms for every image size to come.

    Those in `rooms` stay. Those in `begun`, for which programs are compiled already, are taken
    where they suffice. `limit` is the largest population to come; for the rest see `count_view`.
    """
    found = dict(rooms)
    gaussians, host_alive = jax.tree.map(np.asarray, (gaussians, alive))
    host_owner = None if owner is None else np.asarray(owner)
    for shrink in shrinks:
        for size, cameras in cameras_by_size(views, shrink).items():
            name = size_name(size)
            if name not in found:
                room = room_for(gaussians, host_alive, cameras, limit, cfg, host_owner)
                made = begun.get(name, room)
                found[name] = made if made.holds(room) else room
    return _sharing_visible(found)


def grown(rooms: Mapping[str, Room], size: tuple[int, int], entries: int, visible: int) -> Rooms:
    """Return rooms after a view of this size found none for its entries or visible Gaussians."""
    name = size_name(size)
    return _sharing_visible({**rooms, name: rooms[name].grown(entries, visible)})


def _sharing_visible(rooms: Rooms) -> Rooms:
    """Give all sizes the same room for Gaussians: what is done per Gaussian is shared."""
    most = max((room.visible for room in rooms.values()), default=0)
    return {name: room._replace(visible=most) for name, room in rooms.items()}
