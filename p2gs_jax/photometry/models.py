"""The choices of a calibration: model, white balance, vignetting and kind of curve."""

from __future__ import annotations

from typing import NamedTuple

from p2gs_jax.config import Level, ResponseKind, VignettingKind
from p2gs_jax.config import PhotometricModel as ModelName
from p2gs_jax.photometry.response import BASES, Base, spline_parameters


class Model(NamedTuple):
    """Levels at which exposure and gamma vary (None: they do not), and a description."""

    exposure: Level | None
    gamma: Level | None
    description: str


# In order of complexity.
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
_BY_LEVELS = {(model.exposure, model.gamma): name for name, model in MODELS.items()}
_LEVELS: tuple[Level | None, ...] = (None, "camera", "view")
_VIGNETTING: tuple[VignettingKind | None, ...] = (None, "camera", "channel")

VIGNETTING_POWERS = (2, 4, 6)  # powers of the radius in log V(r) = k1 r^2 + k2 r^4 + k3 r^6


def polynomials(vignetting: VignettingKind | None) -> int:
    """Return the number of polynomials of a camera: 0, 1 for all channels, or 3."""
    return {None: 0, "camera": 1, "channel": 3}[vignetting]


class Form(NamedTuple):
    """The parameters that vary: a model of exposures and gammas, white balance and vignetting."""

    model: ModelName  # model of exposures and gammas
    white_balance: Level | None = None  # level; per view only if exposures are per view
    vignetting: VignettingKind | None = None  # per camera, or per camera and channel

    @property
    def description(self) -> str:
        """Description in reports."""
        text = MODELS[self.model].description
        if self.white_balance is not None:
            text += f", a white balance per {self.white_balance}"
        if self.vignetting is not None:
            text += ", vignetting per camera"
        if self.vignetting == "channel":
            text += " and channel"
        return text


EXPOSURES = Form("view_exposure")


def parameter_count(
    form: Form, by: ResponseKind | None, cameras: int, views: int, power: bool = False
) -> int:
    """Return the number of free parameters, with splines `by` camera or channel, if any.

    Each level loses one parameter to its gauge; gammas and curves lose none if known exposures fix
    the `power`. If every channel has separate exposures and a separate response, photographs do not
    determine the channels' powers, which loses two more parameters.
    """
    size = {None: 0, "camera": cameras - 1, "view": views - 1}
    varies = MODELS[form.model]
    return (
        size[varies.exposure]
        + size[varies.gamma]
        + 2 * size[form.white_balance]
        + cameras * polynomials(form.vignetting) * len(VIGNETTING_POWERS)
        + spline_parameters(by, cameras)
        - 2 * (by == "channel" and form.white_balance == "view")
        + (power and (by is not None or varies.gamma is not None))
    )


class Curve(NamedTuple):
    """A kind of curve: its base, and the kind of fitted splines over it (None: no spline)."""

    base: Base = "srgb"
    splines: ResponseKind | None = None


_ONE_FOR_ALL = Curve("srgb", "all")
_PLAIN = [Curve(base) for base in BASES]
# Neighbours of each kind; several splines are compared only after a spline was chosen.
_CURVES: dict[ResponseKind | None, list[Curve]] = {
    None: [*_PLAIN, _ONE_FOR_ALL],
    "all": [*_PLAIN, Curve("srgb", "camera"), Curve("srgb", "channel")],
    "camera": [_ONE_FOR_ALL, Curve("srgb", "channel")],
    "channel": [_ONE_FOR_ALL, Curve("srgb", "camera")],
}


class Choice(NamedTuple):
    """A form and a kind of curve."""

    form: Form
    curve: Curve = Curve()


class Scope(NamedTuple):
    """Limits of the choices that observations can distinguish."""

    cameras: int  # number of physical cameras
    places: bool  # positions in the images are known, and vignetting can be solved
    curves: bool  # exposures differ enough to determine a curve
    known: bool = False  # the curve is known to be sRGB, and no other is compared
    power: bool = False  # known exposures fix the power of the curve
    each: bool = True  # exposures differ enough within cameras to determine a curve for each

    def allows(self, choice: Choice) -> bool:
        """Return whether a choice differs from simpler ones and can be solved.

        With one physical camera, "per camera" means "for all". A common gamma is then a gauge,
        unless known exposures fix the power of an unknown curve without a spline.
        """
        form, by = choice.form, choice.curve.splines
        exposure, gamma, _ = MODELS[form.model]
        fixed = self.power and by is None and not self.known
        # Exposures are per view, and a power is free or the curve is known.
        free = exposure == "view" and bool(gamma or by or self.known)
        levels = (exposure, None if fixed else gamma, form.white_balance, by)
        return (
            (self.cameras > 1 or "camera" not in levels)
            and (form.white_balance != "view" or exposure == "view")
            and (choice.curve == Curve() or not self.known)
            and (by is None or self.curves)
            and (by != "camera" or self.each)
            and (form.vignetting is None or self.places)
            and (not self.power or free)
        )


def neighbours(choice: Choice, scope: Scope) -> list[Choice]:
    """Return simpler and richer choices of a scope: one property differs, or two dependent ones."""
    form, curve = choice
    exposure, gamma, _ = MODELS[form.model]
    forms = [
        form._replace(model=name)
        for e in _LEVELS
        for g in _LEVELS
        if (e == exposure) != (g == gamma) and (name := _BY_LEVELS.get((e, g)))
    ]
    # These replace two levels at once, because one of them requires the other.
    if gamma is not None and exposure == gamma:
        forms += [form._replace(model=_BY_LEVELS[(None, None)])]
    if form.white_balance == "view" and exposure == "view":
        simpler: list[ModelName] = [k for k, m in MODELS.items() if m.exposure == "camera"]
        forms += [Form(name, "camera", form.vignetting) for name in simpler]
    forms += [form._replace(white_balance=level) for level in _LEVELS]
    forms += [form._replace(vignetting=kind) for kind in _VIGNETTING]
    near = [Choice(f, curve) for f in forms] + [Choice(form, c) for c in _CURVES[curve.splines]]
    if curve.splines == "camera" and (name := _BY_LEVELS.get((exposure, "camera"))):
        # A gamma per camera is the simplest way in which curves of cameras differ.
        near += [Choice(form._replace(model=name), plain) for plain in _PLAIN]
    return [c for c in dict.fromkeys(near) if c != choice and scope.allows(c)]
