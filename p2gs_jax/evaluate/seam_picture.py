"""A picture of a seam: half of one photograph beside half of another, with a hard edge."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Float32
from scipy.spatial.transform import Rotation

from p2gs_jax.evaluate.seams import Photographed, radiance_of
from p2gs_jax.photometry.display import DisplayTransform, develop
from p2gs_jax.render.warp import project_points, sample_bilinear, surface_depth, unproject
from p2gs_jax.types import Camera, Render

# Opacity of the halfway view from which on its rendered depth is used.
OPAQUE = 0.5
# Depth used elsewhere, as a multiple of the largest rendered depth.
FAR = 100.0
BLANK = 0.5


def redeveloped(
    ldr: Float[np.ndarray, "... 3"], own: DisplayTransform, common: DisplayTransform
) -> Float32[np.ndarray, "... 3"]:
    """Return a photograph, taken back to radiance and developed with the common display transform.

    Saturated pixels stay at the value of its white.
    """
    return develop(radiance_of(ldr, own), common)


class SeamPicture(NamedTuple):
    """One picture made of two photographs, with a hard edge in the middle.

    Attributes:
        before: of the photographs as taken.
        after: of the photographs developed alike.
        left_first: the left half is the first photograph.
    """

    before: Float32[np.ndarray, "h w 3"]
    after: Float32[np.ndarray, "h w 3"]
    left_first: bool


def seam_picture(
    first: Photographed,
    second: Photographed,
    common: DisplayTransform,
    render: Callable[[Camera], Render],
) -> SeamPicture:
    """Warp half of each photograph into a camera halfway between the two.

    There is no occlusion test: beside foreground edges the picture repeats the foreground. Pixels
    that a photograph does not cover are grey.

    Args:
        first: one photograph.
        second: the other.
        common: the display transform of "after".
        render: of a camera, with depth.
    """
    camera = camera_between(first.camera, second.camera)
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

    return SeamPicture(joined(before), joined(after), left_first)


def camera_between(first: Camera, second: Camera) -> Camera:
    """Return a camera halfway between two, with the size of the first."""
    viewmats = np.stack([np.asarray(c.viewmat, np.float64) for c in (first, second)])
    turns, shifts = viewmats[:, :3, :3], viewmats[:, :3, 3]
    center = np.mean([-r.T @ t for r, t in zip(turns, shifts, strict=True)], 0)
    viewmat = np.eye(4)
    viewmat[:3, :3] = Rotation.from_matrix(turns).mean().as_matrix()
    viewmat[:3, 3] = -viewmat[:3, :3] @ center
    return Camera(jnp.asarray(viewmat, jnp.float32), first.K, first.width, first.height)
