"""Seams: the difference of photographs of one surface, as taken and under one display transform.

Pixels of one view are found in a neighbouring one through rendered depth, with an occlusion test
(render/warp.py). Over the pixels that both show, unsaturated and not near black, the seam is the
median over pixels and channels of the absolute difference, in 8-bit codes and in stops:

- before: of the photographs as taken. In stops, as if all were taken alike: both are decoded with
  the common gamma, and no exposure is undone.
- after: of the photographs developed alike: each is decoded with its own gamma and response,
  divided by its own exposure, white balance and vignetting, and shown in the common display
  transform.

The step is the constant part of what is left: the median of the signed difference after, in stops.
The rest contains misplaced pixels on texture, view-dependent reflection, and what the formation
model leaves out.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Float32
from scipy.sparse import csr_array

from p2gs_jax.config import LossConfig
from p2gs_jax.core.numerics import evenly_spaced
from p2gs_jax.photometry.cameras import places
from p2gs_jax.photometry.display import DisplayTransform, develop
from p2gs_jax.photometry.formation import inverse_formation, inverse_tone_map
from p2gs_jax.render.warp import sample_bilinear, warp
from p2gs_jax.scene.rigid import moment_of
from p2gs_jax.scene.visibility import project_points, unoccluded
from p2gs_jax.types import Camera, Scene

# Least pixels in common.
FEWEST_PIXELS = 200
# Least points in common of two views that are compared.
FEWEST_SHARED = 30
# Points that overlaps are counted on where there are no tracks.
MOST_COUNTED = 5000


class Photographed(NamedTuple):
    """A photograph with camera, depth and display transform.

    Attributes:
        ldr: display values.
        mask: 1 = use.
        camera: at the size of `ldr`.
        depth: from `surface_depth`, 0 where the view shows no surface.
        transform: how it was taken.
    """

    ldr: Float32[np.ndarray, "h w 3"]
    mask: Float32[np.ndarray, "h w"]
    camera: Camera
    depth: Float[np.ndarray, "h w"]
    transform: DisplayTransform


class Seam(NamedTuple):
    """The difference of two photographs; see the module for the definitions.

    Attributes:
        before_ev: as taken, stops.
        after_ev: developed alike, stops.
        before_codes: as taken, 8-bit codes.
        after_codes: developed alike, 8-bit codes.
        step_ev: by which the first is brighter throughout, developed alike, stops.
        pixels: that both show.
    """

    before_ev: float
    after_ev: float
    before_codes: float
    after_codes: float
    step_ev: float
    pixels: int


def neighbouring_pairs(scene: Scene, most: int) -> list[tuple[int, int]]:
    """Return pairs of training views that should show the same surfaces, rows of `scene.views`.

    On a rig these are different cameras at the same time that share points: of a drive, in the
    same frame; else, files of the same name in different folders. Elsewhere every view is paired
    with the one it shares most with.

    Args:
        scene: with tracks, or points to project.
        most: pairs at most, spread evenly over the views.
    """
    train = scene.train_indices
    shared = _shared_points(scene)
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
    """Return every view with the one it shares most with; among equals, the nearest in order."""
    order = np.arange(len(shared))
    near = shared - np.abs(order[:, None] - order) / (len(shared) + 1)
    np.fill_diagonal(near, -np.inf)
    best = near.argmax(1).tolist() if len(shared) > 1 else []
    pairs = {(min(a, b), max(a, b)) for a, b in enumerate(best)}
    return sorted(p for p in pairs if shared[p] >= FEWEST_SHARED)


def _shared_points(scene: Scene) -> np.ndarray:
    """Return how many points two training views have in common, 0 on the diagonal."""
    train = list(scene.train_indices)
    if scene.tracks is not None and len(scene.tracks.xy):
        where = (scene.tracks.view_indices, scene.tracks.point_indices)
        shape = (len(scene.views), len(scene.points))
        seen = csr_array((np.ones(len(where[0]), np.float32), where), shape=shape)
        seen.data[:] = 1
        seen = seen.tocsr()[train]
    else:
        rows = []
        counted = evenly_spaced(len(scene.points), MOST_COUNTED)
        for view in (scene.views[i] for i in train):
            xy, z = project_points(scene.points, view)
            rows.append(unoccluded(xy, z, view.width, view.height)[counted])
        seen = csr_array(np.array(rows, np.float32))
    shared = (seen @ seen.T).toarray()
    np.fill_diagonal(shared, 0)
    return shared


def measure_seam(
    first: Photographed, second: Photographed, common: DisplayTransform, cfg: LossConfig
) -> Seam | None:
    """Return the seam between two photographs, or None where they have too little in common.

    Args:
        first: in whose pixels the two are compared.
        second: its neighbour.
        common: the display transform of "after", and the gamma of "before".
        cfg: display values between which a pixel is used.
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
    plain = [_decoded(values, common) for values in (a, b)]
    radiance = [
        radiance_of(values, view.transform, places(xy, view.camera.width, view.camera.height))
        for values, view, xy in zip((a, b), (first, second), where, strict=True)
    ]
    shown = [develop(linear, common) for linear in radiance]
    return Seam(
        _apart(np.log2(plain[0]), np.log2(plain[1])),
        _apart(np.log2(radiance[0]), np.log2(radiance[1])),
        255 * _apart(a, b),
        255 * _apart(shown[0], shown[1]),
        float(np.median(np.log2(radiance[0]) - np.log2(radiance[1]))),
        int(use.sum()),
    )


def radiance_of(
    ldr: Float[np.ndarray, "... 3"],
    transform: DisplayTransform,
    positions: Float[np.ndarray, "... 2"] | None = None,
) -> Float32[np.ndarray, "... 3"]:
    """Return the radiance that a photograph shows: what was done to light undone, on the host.

    Args:
        ldr: an image, or loose pixels of one.
        transform: how it was taken.
        positions: of loose pixels, where vignetting counts (photometry/cameras.py:places).
    """
    ldr = np.asarray(ldr, np.float32)
    return inverse_formation(ldr, transform.capture, transform.formation, positions)


def _decoded(ldr: Float[np.ndarray, "m 3"], common: DisplayTransform):
    """Return the exposed radiance of a photograph as if all were taken alike."""
    gamma = np.float32(common.gamma)
    return inverse_tone_map(np.asarray(ldr, np.float32), gamma, common.formation)


def _informative(ldr: Float[np.ndarray, "h w 3"], cfg: LossConfig) -> Bool[np.ndarray, "h w"]:
    return np.all((ldr > cfg.black) & (ldr < cfg.saturation), axis=-1)


def _apart(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.median(np.abs(a - b)))
