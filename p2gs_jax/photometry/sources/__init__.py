"""Where observations of shared points come from; each module returns `Observations`.

`tracks` from matched pixels, `projected` from points of a scene without any, `rendered` from the
depth of a finished fit, `stack` from photographs of one viewpoint. `sampling` reads the colours.
"""

from __future__ import annotations

from collections.abc import Callable

from p2gs_jax.photometry.observations import Observations
from p2gs_jax.photometry.sources.projected import projected_colors
from p2gs_jax.photometry.sources.tracks import has_tracks, track_colors
from p2gs_jax.scene.pixels.store import ImageStore
from p2gs_jax.types import Scene


def surface_colors(
    scene: Scene,
    store: ImageStore,
    seed: int,
    on_view: Callable[[int, int], None] = lambda i, n: None,
) -> Observations:
    """Return colours of shared points: at the tracks, or of projected points where there are none.

    Args:
        scene: with tracks or points.
        store: photographs.
        seed: see `projected_colors`.
        on_view: progress.
    """
    if has_tracks(scene):
        return track_colors(scene, store, on_view)
    return projected_colors(scene, store, seed, on_view)
