"""What may differ between views: the table of photometric models, from the simplest on."""

from __future__ import annotations

from typing import NamedTuple

from p2gs_jax.config import Level, ResponseKind, VignettingKind
from p2gs_jax.config import PhotometricModel as ModelName
from p2gs_jax.photometry.response import Response


class Model(NamedTuple):
    """What varies.

    Attributes:
        exposure: per what the exposure varies; None if it does not.
        gamma: likewise.
        description: what reports call it.
    """

    exposure: Level | None
    gamma: Level | None
    description: str


MODELS: dict[ModelName, Model] = {
    "constant": Model(None, None, "one exposure for all views"),
    "camera_exposure": Model("camera", None, "an exposure per camera"),
    "camera_exposure_gamma": Model("camera", "camera", "an exposure and a gamma per camera"),
    "view_exposure": Model("view", None, "an exposure per view"),
    "view_exposure_camera_gamma": Model(
        "view", "camera", "an exposure per view and a gamma per camera"
    ),
    "view_exposure_gamma": Model("view", "view", "an exposure and a gamma per view"),
}


# Powers of the radius in log V(r) = k1 r^2 + k2 r^4 + k3 r^6.
VIGNETTING_POWERS = (2, 4, 6)


def polynomials(vignetting: VignettingKind | None) -> int:
    """Return the polynomials of a camera: none, one for all channels, or one for each."""
    return {None: 0, "camera": 1, "channel": 3}[vignetting]


class Form(NamedTuple):
    """Everything that may vary: a model of exposures and gammas, and what cameras do besides.

    Attributes:
        model: of exposures and gammas.
        white_balance: per what it varies; per view only where exposures do.
        vignetting: whether cameras darken towards their corners, each channel in its own way or
            all in the same.
    """

    model: ModelName
    white_balance: Level | None = None
    vignetting: VignettingKind | None = None

    @property
    def description(self) -> str:
        """What reports call it."""
        said = MODELS[self.model].description
        if self.white_balance is not None:
            said += f", a white balance per {self.white_balance}"
        if self.vignetting is not None:
            said += ", vignetting per camera"
        if self.vignetting == "channel":
            said += " and channel"
        return said


def possible(form: Form, cameras: int) -> bool:
    """Return whether a form differs from every simpler one, and can be solved.

    Args:
        form: what varies.
        cameras: number of physical cameras; with one, "per camera" means "for all".
    """
    varies = MODELS[form.model]
    levels = (varies.exposure, varies.gamma, form.white_balance)
    if cameras < 2 and "camera" in levels:
        return False
    return form.white_balance != "view" or varies.exposure == "view"


def parameter_count(form: Form, response: Response, cameras: int, views: int) -> int:
    """Return the number of free parameters; each level loses one to its gauge.

    Args:
        form: what varies.
        response: adds those of its splines.
        cameras: number of physical cameras.
        views: number of views.
    """
    size = {None: 0, "camera": cameras - 1, "view": views - 1}
    varies = MODELS[form.model]
    return (
        size[varies.exposure]
        + size[varies.gamma]
        + 2 * size[form.white_balance]
        + cameras * polynomials(form.vignetting) * len(VIGNETTING_POWERS)
        + response.extra_parameters
        - channel_powers(form, response.by)
    )


def channel_powers(form: Form, by: ResponseKind | None) -> int:
    """Return how many powers of channels are gauges beside that of responses by themselves.

    Where every channel has exposures of its own, no photograph tells its power.

    Args:
        form: what varies.
        by: what has a response of its own, or None.
    """
    return 2 if by == "channel" and form.white_balance == "view" else 0
