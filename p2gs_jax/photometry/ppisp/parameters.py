"""What PPISP learns: of every training view, and of every camera."""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from p2gs_jax.core.numerics import on_device
from p2gs_jax.photometry.ppisp import homography, response, vignetting


class OneView(eqx.Module):
    """What light passes on its way into one photograph.

    Attributes:
        exposure: stops.
        color: of `homography`.
        response: of the camera.
        vignetting: of the camera; None: light without a place in an image.
    """

    exposure: Float[Array, ""]
    color: Float[Array, " 8"]
    response: Float[Array, "3 4"]
    vignetting: Float[Array, "3 5"] | None = None


class Ppisp(eqx.Module):
    """The parameters of all training views and cameras; every leaf is learned.

    Attributes:
        exposures: stops.
        colors: of `homography`.
        responses: of each camera.
        vignettings: of each camera.
        names: of the cameras.
        cameras: row in `names` of each training view.
    """

    exposures: Float[Array, " v"]
    colors: Float[Array, "v 8"]
    responses: Float[Array, "c 3 4"]
    vignettings: Float[Array, "c 3 5"]
    names: tuple[str, ...] = eqx.field(static=True)
    cameras: tuple[int, ...] = eqx.field(static=True)

    def view(self, row: Int[Array, ""] | int) -> OneView:
        """Return what holds for a training view."""
        camera = jnp.asarray(self.cameras)[row]
        return OneView(
            self.exposures[row], self.colors[row], self.responses[camera], self.vignettings[camera]
        )

    def mean(self, camera: str | None = None) -> OneView:
        """Return the mean over the training views, for views that have nothing of their own.

        Args:
            camera: whose response and vignetting; of one that is not known, or None: the mean
                response, and no vignetting.
        """
        exposure, color = self.exposures.mean(axis=0), self.colors.mean(axis=0)
        if camera not in self.names:
            return OneView(exposure, color, self.responses.mean(axis=0))
        c = self.names.index(camera)
        return OneView(exposure, color, self.responses[c], self.vignettings[c])


def identity(cameras: Sequence[str]) -> Ppisp:
    """Return parameters that change nothing but to clip at 1.

    Args:
        cameras: of every training view.
    """
    names = tuple(sorted(set(cameras)))
    views = len(cameras)
    return Ppisp(
        on_device(np.zeros(views)),
        on_device(np.zeros((views, homography.PARAMETERS))),
        on_device(np.tile(response.identity_response(), (len(names), 3, 1))),
        on_device(np.zeros((len(names), 3, vignetting.COEFFICIENTS))),
        names,
        tuple(names.index(camera) for camera in cameras),
    )


def applied(linear: Float[Array, "*p 3"], view: OneView) -> Float[Array, "*p 3"]:
    """Return display values, in [0, 1], of radiance.

    Args:
        linear: radiance; an image where the view has vignetting.
        view: what it passes.
    """
    light = jnp.exp2(view.exposure) * linear
    if view.vignetting is not None:
        height, width, _ = linear.shape
        light = light * vignetting.falloff(view.vignetting, height, width)
    return response.respond(homography.recolored(light, view.color), view.response)
