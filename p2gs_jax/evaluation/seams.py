"""Seams: differences of photographs of one surface, before and after a common display transform.

Pixels of one view are found in a neighbouring one through rendered depth, with an occlusion test
(render/warp.py). The seam is the median absolute difference over channels and pixels, in 8-bit
codes and in stops, over pixels that both photographs show neither saturated nor nearly black:

- before: difference of the unchanged photographs. For stops, both are decoded with the common gamma
  and not divided by their exposures.
- after: difference of the photographs under one display transform. Each is decoded with its gamma
  and response, divided by its exposure, white balance and vignetting, and displayed under the
  common transform.

The step is the constant part of the difference "after": the median of the signed difference, in
stops. The rest contains misplaced pixels on texture, view-dependent reflection, and
effects that the formation model lacks.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Float32
from scipy.spatial.transform import Rotation

from p2gs_jax.config import LossConfig
from p2gs_jax.core.numerics import evenly_spaced
from p2gs_jax.gaussians.matching import shared_points, visibility
from p2gs_jax.photometry.display import DisplayTransform, develop, undevelop
from p2gs_jax.photometry.formation import inverse_tone_map, places
from p2gs_jax.render.warp import project_points, sample_bilinear, surface_depth, unproject, warp
from p2gs_jax.scene.rigid import camera_centers, moment_of, pose_of
from p2gs_jax.types import Camera, Render, Scene

# Least number of shared pixels.
FEWEST_PIXELS = 200
# Least number of shared points of a pair of views.
FEWEST_SHARED = 30
# A picture of a seam uses rendered depth where the opacity is at least OPAQUE, and elsewhere FAR
# times the largest rendered depth. Pixels without a photograph have the display value BLANK.
OPAQUE, FAR = 0.5, 100.0
BLANK = 0.5


class Photographed(NamedTuple):
    """A photograph with camera, depth and display transform."""

    ldr: Float32[np.ndarray, "h w 3"]
    mask: Float32[np.ndarray, "h w"]  # 1 = use
    camera: Camera  # at the size of `ldr`
    depth: Float[np.ndarray, "h w"]  # from `surface_depth`, 0 where there is no surface
    transform: DisplayTransform


class Seam(NamedTuple):
    """The difference of two photographs; see the module for the definitions."""

    before_ev: float  # before, stops
    after_ev: float  # after, stops
    before_codes: float  # before, 8-bit codes
    after_codes: float  # after, 8-bit codes
    step_ev: float  # signed median after, first minus second, stops
    pixels: int  # number of shared pixels


def neighbouring_pairs(scene: Scene, most: int) -> list[tuple[int, int]]:
    """Return pairs of training views that show the same surfaces, as rows of `scene.views`.

    On a rig these are different cameras at the same time that share points: in the same frame of a
    drive, or files of the same name in different folders. Otherwise every view is paired with the
    view with which it shares most points. There are at most `most` pairs, evenly spread over views.
    """
    train = scene.train_indices
    shared = shared_points(visibility(scene, 0), len(scene.points))
    np.fill_diagonal(shared, 0)
    moments = [moment_of(scene.views[i]) for i in train]
    cameras = [scene.views[i].camera for i in train]
    together = [
        (a, b)
        for a in range(len(train))
        for b in range(a + 1, len(train))
        if moments[a] == moments[b] and cameras[a] != cameras[b] and shared[a, b] >= FEWEST_SHARED
    ]
    pairs = together or _closest(shared)
    picked = [pairs[k] for k in evenly_spaced(len(pairs), most)]
    return [(train[a], train[b]) for a, b in picked]


def _closest(shared: np.ndarray) -> list[tuple[int, int]]:
    """Return pairs of each view and the view that shares most points (if equal, the nearest)."""
    order = np.arange(len(shared))
    near = shared - np.abs(order[:, None] - order) / (len(shared) + 1)
    np.fill_diagonal(near, -np.inf)
    best = near.argmax(1).tolist() if len(shared) > 1 else []
    pairs = {(min(a, b), max(a, b)) for a, b in enumerate(best)}
    return sorted(p for p in pairs if shared[p] >= FEWEST_SHARED)


def measure_seam(
    first: Photographed, second: Photographed, common: DisplayTransform, cfg: LossConfig
) -> Seam | None:
    """Return the seam between two photographs, or None if they share too few pixels.

    They are compared in the pixels of the first. `common` is the display transform of "after";
    "before" uses its gamma. `cfg` limits the display values of used pixels.
    """
    there = warp(jnp.asarray(first.depth), first.camera, jnp.asarray(second.depth), second.camera)
    ldr = sample_bilinear(jnp.asarray(second.ldr), there.xy)
    kept = sample_bilinear(jnp.asarray(second.mask)[..., None], there.xy)[..., 0] > 0.99
    use = np.asarray(there.seen & kept) & (first.mask > 0.99)
    use &= _informative(first.ldr, cfg) & _informative(np.asarray(ldr), cfg)
    if use.sum() < FEWEST_PIXELS:
        return None
    a, b = first.ldr[use], np.asarray(ldr)[use]
    where = [np.argwhere(use)[:, ::-1] + np.float32(0.5), np.asarray(there.xy)[use]]
    # Radiance as if both had the common parameters.
    gamma, tone = np.float32(common.gamma), common.formation
    plain = [inverse_tone_map(np.asarray(values, np.float32), gamma, tone) for values in (a, b)]
    radiance = [
        undevelop(values, view.transform, places(xy, view.camera.width, view.camera.height))
        for values, view, xy in zip((a, b), (first, second), where, strict=True)
    ]
    developed = [develop(linear, common) for linear in radiance]
    return Seam(
        _apart(np.log2(plain[0]), np.log2(plain[1])),
        _apart(np.log2(radiance[0]), np.log2(radiance[1])),
        255 * _apart(a, b),
        255 * _apart(developed[0], developed[1]),
        float(np.median(np.log2(radiance[0]) - np.log2(radiance[1]))),
        int(use.sum()),
    )


def _informative(ldr: Float[np.ndarray, "h w 3"], cfg: LossConfig) -> Bool[np.ndarray, "h w"]:
    return np.all((ldr > cfg.black) & (ldr < cfg.saturation), axis=-1)


def _apart(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.median(np.abs(a - b)))


class SeamPicture(NamedTuple):
    """Pictures whose halves show two photographs, with a hard edge in the middle."""

    before: Float32[np.ndarray, "h w 3"]  # the unchanged photographs
    after: Float32[np.ndarray, "h w 3"]  # the photographs under one display transform
    left_first: bool  # the left half is the first photograph


def seam_picture(
    first: Photographed,
    second: Photographed,
    common: DisplayTransform,
    render: Callable[[Camera], Render],
) -> SeamPicture:
    """Warp half of each photograph into a camera halfway between the two.

    There is no occlusion test: beside foreground edges the foreground appears twice. Pixels
    that a photograph does not cover are grey. `common` is the display transform of "after", and
    `render` renders a camera with depth.
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
        # A saturated pixel has the radiance at which its photograph saturates.
        common_look = develop(undevelop(ldr, photograph.transform), common)
        reached.append(inside)
        before.append(np.where(inside[..., None], ldr, BLANK))
        after.append(np.where(inside[..., None], common_look, BLANK))
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
    turn = Rotation.from_matrix(viewmats[:, :3, :3]).mean().as_matrix()
    viewmat = pose_of(turn, -turn @ camera_centers(viewmats).mean(0))
    return Camera(jnp.asarray(viewmat, jnp.float32), first.K, first.width, first.height)
