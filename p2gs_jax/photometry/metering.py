"""Metering: the exposure of a new picture, from the radiance that it shows.

A meter reads one number from linear radiance; a rule turns readings into an exposure. Fixed rules
follow camera manuals (mid-grey for the log average, white for the highlights). The fitted
rule is the one that best predicts the exposures that the camera chose.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float

from p2gs_jax.core.numerics import LN2
from p2gs_jax.errors import UserError
from p2gs_jax.photometry.formation import squared_radii

WORDS: dict[str, str] = {  # the meters, and their names in text
    "log_average": "log average",
    "average": "average",
    "centre_log_average": "centre-weighted log average",
    "highlights": "highlights (99th percentile)",
}
METERS = tuple(WORDS)
ExposureOf = Literal["auto", "log_average", "centre", "highlights", "protected"]
Readings = Mapping[str, float]

BT709 = np.array([0.2126, 0.7152, 0.0722])  # luminance of linear red, green and blue
HIGHLIGHT = 99.0  # percentile of the luminance
CENTRE = 0.4  # standard deviation of the weights about the centre, half diagonals
# Lower bound of luminance relative to its mean; pictures show nothing darker.
DARKEST = 2.0**-12
# A picture in which the share of opaque pixels is smaller than this has no readings.
LEAST_SEEN = 0.01
MID_GREY, BELOW_WHITE = 0.18, 0.98  # exposed radiance, and display value
PIXELS = 100_000  # approximate number of pixels that a meter reads
# Cross-validation holds out at most this many stretches of views: neighbours in a video are alike.
FOLDS = 12
FEWEST_VIEWS = 6  # with fewer views the rule is a constant
# A rule explains the camera if its RMS of held-out views is at most this share of a constant's.
EXPLAINS = 0.8
NEGLIGIBLE_EV = 0.05  # exposures that vary by less, stops, count as constant


def meter(linear: Float[np.ndarray, "h w 3"], alpha: Float[np.ndarray, "h w"]) -> dict[str, float]:
    """Return readings of premultiplied radiance, natural logs.

    They are NaN if too little is opaque, or all is black.
    """
    step = max(1, int(np.sqrt(alpha.size / PIXELS)))
    weight = np.asarray(alpha[::step, ::step], np.float64)
    light = np.asarray(linear[::step, ::step], np.float64) @ BT709
    seen = (weight > 0) & np.isfinite(light)
    if weight[seen].sum() < LEAST_SEEN * weight.size:
        return dict.fromkeys(METERS, float("nan"))
    central = (weight * np.exp(-squared_radii(*weight.shape) / (2 * CENTRE**2)))[seen]
    weight, light = weight[seen], np.maximum(light[seen] / weight[seen], 0.0)
    mean = float(np.average(light, weights=weight))
    if not mean > 0:
        return dict.fromkeys(METERS, float("nan"))
    light = np.maximum(light, DARKEST * mean)
    logs = np.log(light)
    return {
        "log_average": float(np.average(logs, weights=weight)),
        "average": float(np.log(np.average(light, weights=weight))),
        "centre_log_average": float(np.average(logs, weights=central)),
        "highlights": float(np.percentile(logs, HIGHLIGHT, weights=weight, method="inverted_cdf")),
    }


@dataclass(frozen=True)
class Rule:
    """A meter whose exposed reading the camera keeps constant: log e = offset - reading."""

    meter: str | None  # name of the meter; None: the exposure itself is constant
    offset: float  # natural logarithm
    # RMS of its errors, stops, where each view was predicted from the others.
    left_out_ev: float = float("nan")

    def log_exposure(self, readings: Readings) -> float:
        """Return the natural logarithm of the exposure; NaN where there is no reading."""
        return self.offset - (0.0 if self.meter is None else readings[self.meter])

    @property
    def words(self) -> str:
        """The name of the rule in text."""
        return "constant" if self.meter is None else WORDS.get(self.meter, self.meter)


@dataclass(frozen=True)
class Metering:
    """Rules for the exposures of new pictures, compared on the exposures of photographs."""

    rule: Rule  # rule of `auto`: the one that explains the photographs, or a constant
    candidates: tuple[Rule, ...]  # all rules that were compared, best first
    white: float  # exposed radiance that is displayed just below white
    names: tuple[str, ...]  # names of the training views
    # Readings of their renders: a row per view, a column for each of `METERS`.
    readings: Float[np.ndarray, "v k"]

    @property
    def constant(self) -> Rule:
        """The rule without a meter: the geometric mean of the exposures of metered views."""
        return next(rule for rule in self.candidates if rule.meter is None)

    def exposure_ev(self, readings: Readings, of: ExposureOf = "auto") -> float:
        """Return the exposure of a picture in stops; see `exposure`."""
        return self._log_exposure(readings, of) / LN2

    def _log_exposure(self, readings: Readings, of: ExposureOf) -> float:
        if of not in get_args(ExposureOf):
            why = f"{of!r} is not a rule of metering."
            raise UserError(why, fix=f"use {', '.join(get_args(ExposureOf))}")
        grey, white = np.log(MID_GREY), np.log(self.white)
        if of == "auto":
            found = self.rule.log_exposure(readings)
        elif of == "highlights":
            found = white - readings["highlights"]
        else:
            found = grey - readings["centre_log_average" if of == "centre" else "log_average"]
            if of == "protected":
                found = min(found, white - readings["highlights"])
        return float(found) if np.isfinite(found) else self.constant.offset

    def exposure(self, readings: Readings, of: ExposureOf = "auto") -> float:
        """Return the exposure of a picture, a factor on radiance.

        NaN readings give the geometric mean of metered views. `auto` follows `rule`; `log_average`
        and `centre` expose that average to mid-grey; `highlights` exposes the 99th percentile to
        just below white; `protected` is `log_average`, or `highlights` where the former would clip
        highlights.
        """
        return float(np.exp(self._log_exposure(readings, of)))

    def typical_exposure(self, of: ExposureOf = "auto") -> float:
        """Return the geometric mean over the training views: one exposure for the whole scene."""
        rows = [dict(zip(METERS, row, strict=True)) for row in self.readings.tolist()]
        return float(np.exp(float(np.mean([self._log_exposure(row, of) for row in rows]))))

    @property
    def telling(self) -> bool:
        """Whether there are enough views, and exposures vary enough, to compare rules."""
        return len(self.candidates) > 1 and self.constant.left_out_ev >= NEGLIGIBLE_EV

    @property
    def sentence(self) -> str:
        """A sentence on the rule that explains the camera's exposures, or on why none does."""
        constant = self.constant.left_out_ev
        rules = [rule for rule in self.candidates if rule.meter is not None]
        if not rules:
            return f"Metering: too few training views can be metered; a rule needs {FEWEST_VIEWS}."
        if constant < NEGLIGIBLE_EV:
            return f"Metering: exposures hardly vary ({constant:.2f} EV): constant."
        if self.rule.meter is None:
            best = rules[0]
            return (
                "New viewpoints are shown at a constant exposure: no metering rule predicts the "
                f"exposures of held-out views better (RMS error {best.left_out_ev:.2f} EV for the "
                f"best of {len(rules)}, {best.words}; {constant:.2f} EV for a constant)."
            )
        return (
            f"Metering: {self.rule.words} explains the exposures (RMS error of held-out views: "
            f"{self.rule.left_out_ev:.2f} EV; with a constant exposure {constant:.2f} EV)."
        )


def fit_metering(
    names: Sequence[str],
    readings: Sequence[Readings],
    log_exposures: Float[np.ndarray, " v"],
    white: float = 1.0,
) -> Metering:
    """Find the metering rule that best predicts the exposures of the training views.

    Every meter is compared, as if the camera had kept its reading constant. Each stretch of views,
    which are in order, is predicted from the others. The rule is a constant exposure unless another
    is clearly better. `white` is the exposed radiance that is displayed just below white.
    """
    table = np.array([[r[name] for name in METERS] for r in readings]).reshape(-1, len(METERS))
    known = np.isfinite(table).all(1)
    x, y = table[known], np.asarray(log_exposures, np.float64)[known]
    if len(y) < FEWEST_VIEWS:
        mean = Rule(None, float(np.mean(log_exposures)))
        return Metering(mean, (mean,), white, tuple(names), table)
    stretches = np.array_split(np.arange(len(y)), min(len(y), FOLDS))
    rules, errors = [], {}
    for name, kept in [(None, y), *zip(METERS, (y[:, None] + x).T, strict=True)]:
        left = [kept[rows] - np.delete(kept, rows).mean() for rows in stretches]
        errors[name] = np.array([np.mean(one**2) for one in left])
        rms = float(np.sqrt(np.mean(np.concatenate(left) ** 2))) / LN2
        rules.append(Rule(name, float(kept.mean()), rms))
    rules.sort(key=lambda rule: rule.left_out_ev)
    constant = next(rule for rule in rules if rule.meter is None)
    best = next(rule for rule in rules if rule.meter is not None)
    gain = errors[None] - errors[best.meter]
    clear = gain.mean() > 2 * gain.std(ddof=1) / np.sqrt(len(gain))
    varies = constant.left_out_ev >= NEGLIGIBLE_EV
    explains = varies and best.left_out_ev <= EXPLAINS * constant.left_out_ev and clear
    return Metering(best if explains else constant, tuple(rules), white, tuple(names), table)


def adapted(exposures_ev: Float[np.ndarray, " f"], frames: float) -> Float[np.ndarray, " f"]:
    """Return exposures, stops, smoothed with exponential weights of scale `frames`."""
    # The weights are symmetric, so that a path played backwards looks the same.
    count = len(exposures_ev)
    away = np.abs(np.arange(count)[:, None] - np.arange(count))
    weight = np.exp(-away / max(frames, 1e-6))
    return weight @ np.asarray(exposures_ev, np.float64) / weight.sum(1)
