"""What may be chosen: a form and a kind of curve; and which choices are one step apart."""

from __future__ import annotations

from typing import NamedTuple

from p2gs_jax.config import Level, ResponseKind, VignettingKind
from p2gs_jax.photometry.models import MODELS, Form, ModelName, possible
from p2gs_jax.photometry.response import BASES, Base

_BY_LEVELS: dict[tuple[Level | None, Level | None], ModelName] = {
    (model.exposure, model.gamma): name for name, model in MODELS.items()
}
_LEVELS: tuple[Level | None, ...] = (None, "camera", "view")
_VIGNETTING: tuple[VignettingKind | None, ...] = (None, "camera", "channel")


class Curve(NamedTuple):
    """A kind of curve.

    Attributes:
        base: what is decoded with.
        splines: what has a fitted spline over it; None: nothing.
    """

    base: Base = "srgb"
    splines: ResponseKind | None = None


_ONE_FOR_ALL = Curve("srgb", "all")
# One step from each kind: several splines are worth trying where one is.
_CURVES: dict[ResponseKind | None, list[Curve]] = {
    None: [*(Curve(base) for base in BASES), _ONE_FOR_ALL],
    "all": [*(Curve(base) for base in BASES), Curve("srgb", "camera"), Curve("srgb", "channel")],
    "camera": [_ONE_FOR_ALL, Curve("srgb", "channel")],
    "channel": [_ONE_FOR_ALL, Curve("srgb", "camera")],
}


class Choice(NamedTuple):
    """What varies, and under which kind of curve.

    Attributes:
        form: what varies.
        curve: how values are decoded.
    """

    form: Form
    curve: Curve = Curve()


class Scope(NamedTuple):
    """What there is to choose from.

    Attributes:
        cameras: number of physical cameras.
        places: positions in the images are known: vignetting can be told.
        curves: exposures differ enough to tell a curve by.
        known: the curve is known, and sRGB's: no other is compared.
    """

    cameras: int
    places: bool
    curves: bool
    known: bool = False

    def allows(self, choice: Choice) -> bool:
        """Return whether a choice differs from simpler ones and can be solved."""
        by = choice.curve.splines
        if self.known and choice.curve != Curve():
            return False
        told = by is None or self.curves
        several = by != "camera" or self.cameras > 1
        seen = choice.form.vignetting is None or self.places
        return told and several and seen and possible(choice.form, self.cameras)


def neighbours(choice: Choice, scope: Scope) -> list[Choice]:
    """Return the choices that differ in one thing, simpler and richer ones.

    Args:
        choice: where from.
        scope: what there is.
    """
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
        forms += [
            Form(name, "camera", form.vignetting)
            for name, model in MODELS.items()
            if model.exposure == "camera"
        ]
    forms += [form._replace(white_balance=level) for level in _LEVELS]
    forms += [form._replace(vignetting=kind) for kind in _VIGNETTING]
    near = [Choice(f, curve) for f in forms] + [Choice(form, c) for c in _CURVES[curve.splines]]
    return [c for c in dict.fromkeys(near) if c != choice and scope.allows(c)]
