"""PPISP, a camera that is learned beside the splats (Deutsch et al., arXiv 2601.18336).

Radiance passes an exposure per view, vignetting per camera and channel, a homography of
chromaticities per view, and a response per camera and channel, in this order. Formulas, constants
and weights come from the paper and its reference implementation (github.com/nv-tlabs/ppisp, 1.2);
where the two differ, the implementation is followed.
"""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Float, Int

from p2gs_jax.core.numerics import on_device, unit_clip
from p2gs_jax.types import Array

# Vignetting of a channel: the centre's x and y, and the coefficients of r^2, r^4, r^6.
COEFFICIENTS = 5
# Chromaticities of blue, red, green and neutral, homogeneous.
SOURCES = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [0.0, 1.0, 1.0], [1 / 3, 1 / 3, 1.0]])
# Change of (r, g) of a point per unit of its parameters. They whiten the parameters, so that all
# have similar effects on the image (paper, B.1; values of the reference implementation).
PRECONDITIONERS = np.array(
    [
        [[0.0480542, -0.0043631], [-0.0043631, 0.0481283]],
        [[0.0580570, -0.0179872], [-0.0179872, 0.0431061]],
        [[0.0433336, -0.0180537], [-0.0180537, 0.0580500]],
        [[0.0128369, -0.0034654], [-0.0034654, 0.0128158]],
    ]
)
EPSILON = 1e-5  # added to an intensity before division by it, so that black stays black
# Lower bounds of the response's toe, shoulder and gamma.
LEAST_TOE, LEAST_SHOULDER, LEAST_GAMMA = 0.3, 0.3, 0.1
# Distance from black and white below which powers have no gradient, because it may be infinite.
FLAT = 1e-6
# Weights, and transitions of the Huber losses (paper, table 7; the centre's weight comes from the
# reference implementation, which has means where the paper has sums).
EXPOSURE, EXPOSURE_DELTA = 1.0, 0.1
COLOR, COLOR_DELTA = 1.0, 0.005
CHANNELS = 0.1
CENTRE, BRIGHTENING = 0.02, 0.01


class OneView(eqx.Module):
    """The parameters of one photograph."""

    exposure: Float[Array, ""]  # stops
    color: Float[Array, " 8"]  # parameters of `homography_of`
    response: Float[Array, "3 4"]  # response of the camera, as `raw` of `respond`
    # Vignetting of the camera; None: colours without a position in an image.
    vignetting: Float[Array, "3 5"] | None = None


class Ppisp(eqx.Module):
    """The parameters of all training views and cameras; every leaf is learned."""

    exposures: Float[Array, " v"]  # stops
    colors: Float[Array, "v 8"]  # parameters of `homography_of`
    responses: Float[Array, "c 3 4"]  # response of each camera
    vignettings: Float[Array, "c 3 5"]  # vignetting of each camera
    names: tuple[str, ...] = eqx.field(static=True)  # names of the cameras
    cameras: tuple[int, ...] = eqx.field(static=True)  # row in `names` of each training view

    def view(self, row: Int[Array, ""] | int) -> OneView:
        """Return the parameters of a training view."""
        camera = jnp.asarray(self.cameras)[row]
        return OneView(
            self.exposures[row], self.colors[row], self.responses[camera], self.vignettings[camera]
        )

    def mean(self, camera: str | None = None) -> OneView:
        """Return the mean over the training views, for views that were not fitted.

        Response and vignetting are the camera's; an unknown camera (or None) has the mean response
        and no vignetting.
        """
        exposure, color = self.exposures.mean(axis=0), self.colors.mean(axis=0)
        if camera not in self.names:
            return OneView(exposure, color, self.responses.mean(axis=0))
        c = self.names.index(camera)
        return OneView(exposure, color, self.responses[c], self.vignettings[c])


def identity(cameras: Sequence[str]) -> Ppisp:
    """Return parameters that only clip at 1; `cameras` is the camera of every view."""
    names, views = tuple(sorted(set(cameras))), len(cameras)
    responses = np.tile(identity_response(), (len(names), 3, 1))
    vignettings = np.zeros((len(names), 3, COEFFICIENTS))
    learned = (np.zeros(views), np.zeros((views, 2 * len(SOURCES))), responses, vignettings)
    rows = tuple(names.index(camera) for camera in cameras)
    return Ppisp(*map(on_device, learned), names=names, cameras=rows)


def applied(linear: Float[Array, "*p 3"], view: OneView) -> Float[Array, "*p 3"]:
    """Return display values in [0, 1] of radiance, which is an image if there is vignetting."""
    light = jnp.exp2(view.exposure) * linear
    if view.vignetting is not None:
        height, width, _ = linear.shape
        light = light * falloff(view.vignetting, height, width)
    return respond(recolored(light, view.color), view.response)


def falloff(
    parameters: Float[Array, "3 c"], height: int, width: int
) -> Float[Array, "{height} {width} 3"]:
    """Return 1 + a1 r^2 + a2 r^4 + a3 r^6 of every pixel and channel, clipped to [0, 1].

    Lengths are in units of the longer side, from the centre of the image. Parameters are the
    optical centre (x, y) of each channel, and its a1, a2, a3; zeros change nothing.
    """
    centre, (a1, a2, a3) = parameters[:, :2], parameters[:, 2:].T
    longer = max(height, width)
    x = (jnp.arange(width, dtype=parameters.dtype) + 0.5 - width / 2) / longer
    y = (jnp.arange(height, dtype=parameters.dtype) + 0.5 - height / 2) / longer
    r2 = (y[:, None, None] - centre[:, 1]) ** 2 + (x[:, None] - centre[:, 0]) ** 2
    return unit_clip(1 + r2 * (a1 + r2 * (a2 + r2 * a3)))


def offsets(parameters: Float[Array, "... 8"]) -> Float[Array, "... 4 2"]:
    """Return the displacements of the four chromaticities."""
    pairs = parameters.reshape(*parameters.shape[:-1], 4, 2)
    blocks = jnp.asarray(PRECONDITIONERS, parameters.dtype)
    return jnp.einsum("...ki,kij->...kj", pairs, blocks)


def homography_of(parameters: Float[Array, " 8"]) -> Float[Array, "3 3"]:
    """Return the homography of chromaticities that maps `SOURCES` to their displaced points.

    Colours are homogeneous (R, G, R + G + B), so that (R, G) / (R + G + B) are chromaticities in a
    plane. With the sources of blue, red, green as columns of S and their
    targets as columns of T, H S = T diag(k). The neutral source is S (1, 1, 1) / 3, so T k must be
    the neutral target up to scale: k is its coordinates in the basis T. Each point has two
    parameters; zeros give the identity.
    """
    sources = jnp.asarray(SOURCES, parameters.dtype)
    targets = sources.at[:, :2].add(offsets(parameters))
    blue, red, green, neutral = targets
    # Cramer's rule; the determinant of T is a common factor.
    pairs = ((red, green), (green, blue), (blue, red))
    k = jnp.stack([neutral @ jnp.cross(a, b) for a, b in pairs])
    inverse = jnp.asarray(np.linalg.inv(SOURCES[:3].T), parameters.dtype)
    h = (targets[:3].T * k) @ inverse
    return h / h[2, 2]


def recolored(rgb: Float[Array, "... 3"], parameters: Float[Array, " 8"]) -> Float[Array, "... 3"]:
    """Return linear colours under their homography, which keeps R + G + B up to `EPSILON`."""
    intensity = rgb.sum(-1, keepdims=True)
    moved = jnp.concatenate([rgb[..., :2], intensity], -1) @ homography_of(parameters).T
    # The bound keeps colours beyond the horizon of the homography from being negative.
    moved = moved * intensity / (jnp.maximum(moved[..., 2:], 0.0) + EPSILON)
    red, green = moved[..., 0], moved[..., 1]
    return jnp.stack([red, green, moved[..., 2] - red - green], -1)


def identity_response() -> Float[np.ndarray, " 4"]:
    """Return the parameters whose response is y = x: all powers 1, centre 1/2."""
    least = np.array([LEAST_TOE, LEAST_SHOULDER, LEAST_GAMMA])
    return np.append(np.log(np.expm1(1.0 - least)), 0.0)


def respond(light: Float[Array, "... 3"], raw: Float[Array, "3 4"]) -> Float[Array, "... 3"]:
    """Return display values of light, clipped to [0, 1]; 0 maps to 0, and 1 to 1.

    y = a (x / c)^t up to the centre c and 1 - (1 - a) ((1 - x) / (1 - c))^s beyond it, to the power
    of g; a gives both parts the same slope at c. `raw` has, for each channel, the arguments of
    softplus (toe t >= 0.3, shoulder s >= 0.3, gamma g >= 0.1) and of a sigmoid (centre c).
    """
    toe = LEAST_TOE + jax.nn.softplus(raw[:, 0])
    shoulder = LEAST_SHOULDER + jax.nn.softplus(raw[:, 1])
    gamma = LEAST_GAMMA + jax.nn.softplus(raw[:, 2])
    centre = jax.nn.sigmoid(raw[:, 3])
    at_centre = shoulder * centre / (toe + centre * (shoulder - toe))
    x = unit_clip(light)
    low = at_centre * _power(x / centre, toe)
    high = 1.0 - (1.0 - at_centre) * _power((1.0 - x) / (1.0 - centre), shoulder)
    return _power(jnp.where(x <= centre, low, high), gamma, 0.0)


def _power(base: Float[Array, "..."], exponent: Float[Array, "..."], flat: float = FLAT):
    """Return base^exponent; 0 with zero gradient up to `flat`."""
    on = base > flat
    return jnp.where(on, jnp.exp(exponent * jnp.log(jnp.where(on, base, 1.0))), 0.0)


def regularisation_of(parameters: Ppisp) -> Float[Array, ""]:
    """Return the regularisers that separate parameters from radiance (paper, 4.6).

    They pull means over views of exposures and chromaticities to 0, channels of a camera to each
    other, optical centres to the image centre, and brightening coefficients of vignetting to 0. The
    weighted sum is 0 at the identity.
    """
    vignettings, responses = parameters.vignettings, parameters.responses
    bright, moved = parameters.exposures.mean(), offsets(parameters.colors).mean(axis=0)
    return (
        EXPOSURE * optax.huber_loss(bright, delta=EXPOSURE_DELTA) / EXPOSURE_DELTA
        + COLOR * optax.huber_loss(moved, delta=COLOR_DELTA).mean() / COLOR_DELTA
        + CHANNELS * (vignettings.var(axis=1).mean() + responses.var(axis=1).mean())
        + CENTRE * (vignettings[..., :2] ** 2).sum(-1).mean()
        + BRIGHTENING * jnp.maximum(vignettings[..., 2:], 0.0).mean()
    )
