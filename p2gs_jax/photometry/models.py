"""What may be chosen: the table of photometric models, what cameras do besides, kinds of curves."""

from __future__ import annotations

from typing import NamedTuple

from p2gs_jax.config import Level, ResponseKind, VignettingKind
from p2gs_jax.config import PhotometricModel as ModelName
from p2gs_jax.photometry.response import BASES, Base, spline_parameters


class Model(NamedTuple):
    """What varies: per what the exposure and the gamma do (None: not), and in words."""

    exposure: Level | None
    gamma: Level | None
    description: str


# From the simplest on.
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
    """Return the polynomials of a camera: none, one for all channels, or one for each."""
    return {None: 0, "camera": 1, "channel": 3}[vignetting]


class Form(NamedTuple):
    """Everything that may vary: a model of exposures and gammas, and what cameras do besides."""

    model: ModelName  # of exposures and gammas
    white_balance: Level | None = None  # per what it varies; per view only where exposures do
    # Whether cameras darken towards their corners, each channel in its own way or all in the same.
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


EXPOSURES = Form("view_exposure")


def parameter_count(
    form: Form, by: ResponseKind | None, cameras: int, views: int, power: bool = False
) -> int:
    """Return the number of free parameters, with splines `by` camera or channel, if any.

    Each level loses one to its gauge; that of gammas and curves is none where known exposures tell
    the `power`. Where every channel has exposures of its own, no photograph tells its power: two
    more are gauges beside that of responses by themselves.
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
    """A kind of curve: its base, and what has a fitted spline over it (None: nothing)."""

    base: Base = "srgb"
    splines: ResponseKind | None = None


_ONE_FOR_ALL = Curve("srgb", "all")
_PLAIN = [Curve(base) for base in BASES]
# One step from each kind: several splines are worth trying where one is.
_CURVES: dict[ResponseKind | None, list[Curve]] = {
    None: [*_PLAIN, _ONE_FOR_ALL],
    "all": [*_PLAIN, Curve("srgb", "camera"), Curve("srgb", "channel")],
    "camera": [_ONE_FOR_ALL, Curve("srgb", "channel")],
    "channel": [_ONE_FOR_ALL, Curve("srgb", "camera")],
}


class Choice(NamedTuple):
    """What varies, and under which kind of curve."""

    form: Form
    curve: Curve = Curve()


class Scope(NamedTuple):
    """What there is to choose from."""

    cameras: int  # number of physical cameras
    places: bool  # positions in the images are known: vignetting can be told
    curves: bool  # exposures differ enough to tell a curve by
    known: bool = False  # the curve is known, and sRGB's: no other is compared
    power: bool = False  # known exposures tell the power of the curve

    def allows(self, choice: Choice) -> bool:
        """Return whether a choice differs from simpler ones and can be solved.

        With one physical camera, "per camera" means "for all": of gammas that is a gauge, unless
        known exposures tell the power.
        """
        form, by = choice.form, choice.curve.splines
        exposure, gamma, _ = MODELS[form.model]
        told = self.power and by is None and not self.known
        levels = (exposure, None if told else gamma, form.white_balance, by)
        return (
            (self.cameras > 1 or "camera" not in levels)
            and (form.white_balance != "view" or exposure == "view")
            and (choice.curve == Curve() or not self.known)
            and (by is None or self.curves)
            and (form.vignetting is None or self.places)
            and (not self.power or self._free(choice))
        )

    def _free(self, choice: Choice) -> bool:
        """Return whether exposures are as they are known, and a power is free beside them."""
        varies, by = MODELS[choice.form.model], choice.curve.splines
        return varies.exposure == "view" and bool(varies.gamma or by or self.known)


def neighbours(choice: Choice, scope: Scope) -> list[Choice]:
    """Return the choices of a scope that differ in one thing, simpler and richer ones."""
    form, curve = choice
    exposure, gamma, _ = MODELS[form.model]
    forms = [
        form._replace(model=name)
        for e in _LEVELS
        for g in _LEVELS
        if (e == exposure) != (g == gamma) and (name := _BY_LEVELS.get((e, g)))
    ]
    # Exposures alone may not become simpler while more depends on them.
    if gamma is not None and exposure == gamma:
        forms += [form._replace(model=_BY_LEVELS[(None, None)])]
    if form.white_balance == "view" and exposure == "view":
        simpler: list[ModelName] = [k for k, m in MODELS.items() if m.exposure == "camera"]
        forms += [Form(name, "camera", form.vignetting) for name in simpler]
    forms += [form._replace(white_balance=level) for level in _LEVELS]
    forms += [form._replace(vignetting=kind) for kind in _VIGNETTING]
    near = [Choice(f, curve) for f in forms] + [Choice(form, c) for c in _CURVES[curve.splines]]
    if curve.splines == "camera" and (name := _BY_LEVELS.get((exposure, "camera"))):
        # Gammas per camera are the simplest curves of their own.
        near += [Choice(form._replace(model=name), plain) for plain in _PLAIN]
    return [c for c in dict.fromkeys(near) if c != choice and scope.allows(c)]
