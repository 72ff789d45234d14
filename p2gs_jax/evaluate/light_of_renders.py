"""What the render of another program shows, so that it can be shown under another exposure."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32

from p2gs_jax.evaluate.alignment import with_fitted_exposure
from p2gs_jax.evaluate.renders_of_others import Rendered
from p2gs_jax.photometry.display import DisplayTransform, develop, undevelop
from p2gs_jax.photometry.formation import LEAST_ALPHA
from p2gs_jax.scene.images import ImageStore
from p2gs_jax.scene.pixels.decode import floats


class Light(NamedTuple):
    """What a render shows, so that it can be shown under another exposure.

    Attributes:
        linear: radiance, premultiplied by `alpha`.
        shown: how it becomes the picture.
        picture: display values.
        alpha: opacity, over the backdrop of `shown`; None: it is over nothing.
    """

    linear: Float32[np.ndarray, "h w 3"]
    shown: DisplayTransform
    picture: Float32[np.ndarray, "h w 3"]
    alpha: Float32[np.ndarray, "h w"] | None

    def fitted(
        self, photograph: Float32[np.ndarray, "h w 3"], mask: Float32[np.ndarray, "h w"]
    ) -> DisplayTransform:
        """Return how it is shown under the exposure that fits a photograph best."""
        return with_fitted_exposure(self.shown, self.linear, photograph, mask, self.alpha)

    def under(self, shown: DisplayTransform) -> Float32[np.ndarray, "h w 3"]:
        """Return it as a picture."""
        return develop(self.linear, shown, alpha=self.alpha)


def light_of(rendered: Rendered, shown: DisplayTransform, store: ImageStore, row: int) -> Light:
    """Return what a render shows.

    A picture does not say where its background is. Its photograph does: what that covers moves with
    the exposure, and the rest stays as the picture has it.

    Args:
        rendered: the render.
        shown: how radiance is shown.
        store: photographs.
        row: of the view.
    """
    pixels, linear, opacity = rendered
    if linear:
        opacity = None if store.backdrop is None else opacity
        shown = replace(shown, backdrop=store.backdrop_values)
        return Light(pixels, shown, develop(pixels, shown, alpha=opacity), opacity)
    # A correction of display values belongs to renders of this run.
    shown = replace(shown, correction=None)
    found = store.alpha(row)
    if found is None:
        return Light(undevelop(pixels, shown), shown, pixels, None)
    alpha, backdrop = floats(found), np.asarray(store.backdrop, np.float32)
    covered, free = (np.maximum(a, LEAST_ALPHA)[..., None] for a in (alpha, 1 - alpha))
    own = np.clip((pixels - (1 - alpha[..., None]) * backdrop) / covered, 0, 1)
    behind = (pixels - alpha[..., None] * own) / free
    shown = replace(shown, backdrop=behind)
    return Light(covered * undevelop(own, shown), shown, pixels, alpha)
