"""Panoramas: pinhole images around a common centre, reprojected to a cylinder.

Photographs are stitched with hard edges, so that their seams show. A wide view of the radiance
field is stitched the same way, from narrow slices around one centre.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int

from p2gs_jax.paths.cylinder import Cylinder, project
from p2gs_jax.paths.geometry import rigid
from p2gs_jax.paths.shots import Shot
from p2gs_jax.scene.rigid import inverse

# Angle of a slice: the affine approximation of splats is off far from the axis; in narrow slices it
# is nearly the same on both sides of an edge.
WIDEST_SLICE = np.deg2rad(20)
# Opacity from which on expected depth is used; below it the surface counts as infinitely far.
OPAQUE = 0.5

Layers = tuple[np.ndarray, np.ndarray, np.ndarray]  # linear [h w 3], alpha [h w], depth [h w]


class Stitched(NamedTuple):
    """A cylindrical image, and the camera each pixel was taken from.

    Attributes:
        image: 0 where no camera sees.
        source: row of the camera, -1 for none.
    """

    image: Float32[np.ndarray, "h w c"]
    source: Int[np.ndarray, "h w"]


class Wide(NamedTuple):
    """A wide view of the field.

    Attributes:
        linear: radiance, premultiplied by alpha.
        alpha: opacity.
        nearness: 1 / distance from the cylinder's axis, 0 where nothing opaque is seen.
    """

    linear: Float32[np.ndarray, "h w 3"]
    alpha: Float32[np.ndarray, "h w"]
    nearness: Float32[np.ndarray, "h w"]


def stitch(
    images: Sequence[Float32[np.ndarray, "h w c"]],
    shots: Sequence[Shot],
    cylinder: Cylinder,
    nearness: Float[np.ndarray, "h w"] | None = None,
    masks: Sequence[Float32[np.ndarray, "h w"]] | None = None,
) -> Stitched:
    """Reproject images to a cylinder: every pixel from the one camera that sees it most centrally.

    Nothing is blended, so that differences show.

    Args:
        images: of at most 4 channels.
        shots: their cameras.
        cylinder: where they go.
        nearness: 1 / distance from the cylinder's axis; None reprojects at infinity, which is
            exact for cameras with a common centre.
        masks: 1 = use, 0 = ignore.
    """
    rays = cylinder.rays()
    origin = inverse(cylinder.viewmat)[:3, 3]
    out = np.zeros((*rays.shape[:2], images[0].shape[2]), np.float32)
    source = np.full(rays.shape[:2], -1)
    best = np.full(rays.shape[:2], -np.inf)
    for k, (image, shot) in enumerate(zip(images, shots, strict=True)):
        if image.shape[:2] != (shot.height, shot.width):
            raise ValueError(f"image {k} is {image.shape[:2]}, its camera not")
        seen = project(shot, rays, origin, nearness)
        at = (seen.xy - 0.5).astype(np.float32)
        better = seen.inside & (seen.cosine > best)
        if masks is not None:
            better &= _sample(masks[k], at) > 0.99
        out[better] = _sample(image, at)[better]
        source[better], best[better] = k, seen.cosine[better]
    return Stitched(out, source)


def _sample(image: np.ndarray, at: Float32[np.ndarray, "h w 2"]) -> np.ndarray:
    """Interpolate at positions in OpenCV's convention: pixel centres at integers."""
    values = np.ascontiguousarray(image, np.float32)
    x, y = np.ascontiguousarray(at[..., 0]), np.ascontiguousarray(at[..., 1])
    out = cv2.remap(values, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return out.reshape(*at.shape[:2], *image.shape[2:])


def slices(cylinder: Cylinder) -> list[Shot]:
    """Return pinhole cameras of one size that together see a cylinder from its centre.

    They have its resolution in their middle and a finer one towards their edges.
    """
    count = max(1, int(np.ceil(cylinder.span / WIDEST_SLICE)))
    half = cylinder.span / count / 2
    f = cylinder.focal
    tallest = max(abs(cylinder.top), abs(cylinder.top + cylinder.height / f))
    # One more pixel on each side for interpolation; principal point in the middle.
    width = 2 * (int(np.ceil(f * np.tan(half))) + 1)
    height = 2 * (int(np.ceil(f * tallest / np.cos(half))) + 1)
    K = np.array([[f, 0, width / 2], [0, f, height / 2], [0, 0, 1.0]])
    out = []
    for k in range(count):
        middle = cylinder.left + (2 * k + 1) * half
        sine, cosine = np.sin(middle), np.cos(middle)
        turn = np.array([[cosine, 0, -sine], [0, 1, 0], [sine, 0, cosine]])
        viewmat = rigid(turn, np.zeros(3)) @ cylinder.viewmat
        out.append(Shot(f"slice_{k}", viewmat, K, width, height))
    return out


def render_wide(render: Callable[[Shot], Layers], cylinder: Cylinder) -> Wide:
    """Render a wide view.

    Args:
        render: returns linear radiance, alpha and alpha-weighted depth of a pinhole camera.
        cylinder: the view.
    """
    shots = slices(cylinder)
    colours, nearness = [], []
    for shot in shots:
        linear, alpha, depth = render(shot)
        colours.append(np.concatenate([linear, alpha[..., None]], -1))
        # From depth along the slice's axis to distance from the cylinder's.
        x = (np.arange(shot.width) + 0.5 - shot.K[0, 2]) / shot.K[0, 0]
        opaque = alpha > OPAQUE
        z = np.where(opaque, depth / np.maximum(alpha, OPAQUE), np.inf)
        nearness.append((1 / (np.maximum(z, 1e-9) * np.sqrt(1 + x**2)))[..., None])
    colour = stitch(colours, shots, cylinder).image
    return Wide(colour[..., :3], colour[..., 3], stitch(nearness, shots, cylinder).image[..., 0])
