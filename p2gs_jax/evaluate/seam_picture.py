"""A seam to look at: half of one photograph beside half of another, with a hard edge."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Float32
from scipy.spatial.transform import Rotation

from p2gs_jax.evaluate.seams import Photographed, decoded
from p2gs_jax.photometry.display import DisplayTransform, develop
from p2gs_jax.render.warp import project_points, sample_bilinear, surface_depth, unproject
from p2gs_jax.types import Camera, Render

# Where the halfway view is at least this opaque, the picture trusts the rendered depth.
OPAQUE = 0.5
# Elsewhere it shows something this many times farther than anything it sees.
FAR = 100.0
BLANK = 0.5


def redeveloped(
    ldr: Float[np.ndarray, "... 3"], own: DisplayTransform, common: DisplayTransform
) -> Float32[np.ndarray, "... 3"]:
    """Return a photograph as it would look had it been taken in the common display transform.

    What it saturated stays at the value of its white.
    """
    return develop(decoded(ldr, own) / own.exposure, common)


class Halves(NamedTuple):
    """One picture made of two photographs, with a hard edge in the middle.

    Attributes:
        before: of the photographs as taken.
        after: of the photographs developed alike.
        left_first: the left half is the first photograph.
    """

    before: Float32[np.ndarray, "h w 3"]
    after: Float32[np.ndarray, "h w 3"]
    left_first: bool


def halves(
    first: Photographed,
    second: Photographed,
    common: DisplayTransform,
    render: Callable[[Camera], Render],
) -> Halves:
    """Show half of each photograph as a camera halfway between the two sees it.

    Hidden surfaces are not looked for: beside foreground edges the picture repeats the foreground.
    What a photograph does not reach is grey.

    Args:
        first: one photograph.
        second: the other.
        common: the display transform of "after".
        render: of a camera, with depth.
    """
    camera = halfway(first.camera, second.camera)
    result = render(camera)
    depth = np.asarray(surface_depth(result, OPAQUE))
    known = depth > 0
    far = FAR * (float(depth[known].max()) if known.any() else 1.0)
    points = unproject(jnp.asarray(np.where(known, depth, far)), camera)
    reached, before, after = [], [], []
    for photograph in (first, second):
        xy, z = project_points(points, photograph.camera)
        size = jnp.array([photograph.camera.width, photograph.camera.height])
        inside = np.asarray((z > 1e-6) & jnp.all((xy >= 0) & (xy < size), axis=-1))
        ldr = np.asarray(sample_bilinear(jnp.asarray(photograph.ldr), xy))
        alike = redeveloped(ldr, photograph.transform, common)
        reached.append(inside)
        before.append(np.where(inside[..., None], ldr, BLANK))
        after.append(np.where(inside[..., None], alike, BLANK))
    edge = camera.width // 2
    left_first = bool(
        reached[0][:, :edge].sum() + reached[1][:, edge:].sum()
        >= reached[1][:, :edge].sum() + reached[0][:, edge:].sum()
    )
    left, right = (0, 1) if left_first else (1, 0)

    def joined(images: list[np.ndarray]) -> np.ndarray:
        return np.concatenate([images[left][:, :edge], images[right][:, edge:]], 1)

    return Halves(joined(before), joined(after), left_first)


def halfway(first: Camera, second: Camera) -> Camera:
    """Return a camera halfway between two, with the size of the first."""
    viewmats = np.stack([np.asarray(c.viewmat, np.float64) for c in (first, second)])
    turns, shifts = viewmats[:, :3, :3], viewmats[:, :3, 3]
    center = np.mean([-r.T @ t for r, t in zip(turns, shifts, strict=True)], 0)
    viewmat = np.eye(4)
    viewmat[:3, :3] = Rotation.from_matrix(turns).mean().as_matrix()
    viewmat[:3, 3] = -viewmat[:3, :3] @ center
    return Camera(jnp.asarray(viewmat, jnp.float32), first.K, first.width, first.height)
