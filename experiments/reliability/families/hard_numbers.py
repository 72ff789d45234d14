"""Whole fits of scenes with extreme numbers, and the result that each has to end in."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from reliability.families._scenes import SMALL_FIT, Made, in_a_row, write_scene
from reliability.family import Failure, Family, Report

from p2gs_jax import UserError, fit
from p2gs_jax.core.progress import Silent
from p2gs_jax.formats.ply import read_ply
from p2gs_jax.jobs.configs import with_fields
from p2gs_jax.presets import preset

NAME = "hard_numbers"
ABOUT = """
Whole fits of photographs that show nothing, exposures and radiances at the ends of float32, cameras
at useless places, and far too little of everything. A case is survived if the fit or the refusal
that `CASES` asks for happens. All that a fit writes is then finite, and it names the exposures that
cannot be known.
"""
OPTIONS = SMALL_FIT | {"train.steps": 60}


@dataclass(frozen=True)
class Case:
    """A scene and what has to become of it.

    Attributes:
        made: the scene.
        says: words that the notes of the fit, or the refusal, hold.
        refused: it is refused.
        unknown: views whose exposure must be said to be unknown.
        least_db: PSNR of the training views that a fit reaches at least.
        options: beside those of all.
    """

    made: Made
    says: tuple[str, ...] = ()
    refused: bool = False
    unknown: tuple[str, ...] = ()
    least_db: float | None = None
    options: Mapping[str, object] = field(default_factory=dict)


def _constant(value: float) -> Callable[[int, np.ndarray], np.ndarray]:
    return lambda row, image: np.full_like(image, value)


def _noise(row: int, image: np.ndarray) -> np.ndarray:
    return np.random.default_rng(row).random(image.shape)


def _only(row: int, develop: Callable) -> Callable[[int, np.ndarray], np.ndarray]:
    return lambda k, image: develop(k, image) if k == row else image


def _hidden(*rows: int) -> Callable[[int, int, int], np.ndarray]:
    """Return masks that hide all of these views, and of the others nothing."""
    return lambda row, h, w: np.full((h, w), 0 if row in rows else 255, np.uint8)


def _turned(angle: float) -> Callable[[int], list[tuple[np.ndarray, np.ndarray]]]:
    c, s = math.cos(angle), math.sin(angle)
    roll = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    return lambda count: [(roll, center) for _, center in in_a_row(count)]


def _at_one_point(count: int) -> list[tuple[np.ndarray, np.ndarray]]:
    angles = np.linspace(-0.1, 0.1, count)
    return [
        (np.array([[math.cos(a), 0, math.sin(a)], [0, 1, 0], [-math.sin(a), 0, math.cos(a)]]), zero)
        for a, zero in zip(angles, np.zeros((count, 3)), strict=True)
    ]


def _on_the_axis(count: int) -> list[tuple[np.ndarray, np.ndarray]]:
    return [(np.eye(3), np.array([0.0, 0.0, z])) for z in np.linspace(-0.6, 0.6, count)]


ALL = tuple(f"{k}.png" for k in range(6))
FAIR = 14.0  # dB
CASES: dict[str, Case] = {
    "nothing hard": Case(Made(), least_db=FAIR),
    "all black": Case(Made(develop=_constant(0.0)), unknown=ALL),
    "all white": Case(Made(develop=_constant(1.0)), unknown=ALL),
    "all one colour": Case(Made(develop=_constant(0.5)), least_db=30.0),
    "all identical": Case(Made(develop=lambda row, image: _noise(0, image))),
    "all noise": Case(Made(develop=_noise)),
    "one noise": Case(Made(develop=_only(2, _noise)), least_db=10.0),
    "one black": Case(Made(develop=_only(2, _constant(0.0))), unknown=("2.png",), least_db=FAIR),
    "one white": Case(Made(develop=_only(2, _constant(1.0))), unknown=("2.png",), least_db=FAIR),
    "exposures 20 stops apart": Case(
        Made(exposures=(-10, -2, 0, 0.5, 2, 10)), unknown=("0.png", "5.png")
    ),
    "radiance 1e-6": Case(Made(light=1e-6), unknown=ALL),
    "radiance 1e6": Case(Made(light=1e6), unknown=ALL),
    "cameras at one point": Case(Made(cameras=_at_one_point)),
    "cameras along their axis": Case(Made(cameras=_on_the_axis), least_db=10.0),
    "upside down": Case(Made(cameras=_turned(math.pi)), least_db=FAIR),
    "scale 1e-3": Case(Made(scale=1e-3), least_db=FAIR),
    "scale 1e3": Case(Made(scale=1e3), least_db=FAIR),
    "scale 1e-6": Case(Made(scale=1e-6), least_db=FAIR),
    "10^6 m from the origin": Case(
        Made(origin=(1e6, -1e6, 0)), says=("relative to",), least_db=FAIR
    ),
    "two views": Case(Made(views=2), options={"data.test_every": 0}, least_db=10.0),
    "one Gaussian": Case(Made(), options={"densify.max_gaussians": 1}, says=("thinned to 1",)),
    "one point": Case(Made(points=1)),
    "no matches": Case(Made(tracks=False), says=("No tracks",)),
    "sizes and shapes mixed": Case(
        Made(sizes=((64, 48), (48, 64), (80, 40), (33, 33))), least_db=12.0
    ),
    "everything masked": Case(Made(mask=_hidden(*range(6))), refused=True, says=("mask",)),
    "one view masked": Case(Made(mask=_hidden(2)), says=("2.png", "hidden"), least_db=FAIR),
    "held-out view masked": Case(Made(mask=_hidden(0)), says=("0.png", "hidden"), least_db=FAIR),
}
NOTHING: dict[str, str | float] = {"outcome": "", "training PSNR dB": "", "unknown": ""}
QUICK = ("nothing hard", "all black", "one white", "10^6 m from the origin", "one view masked")


class _Heard(Silent):
    """Keeps the messages of a fit."""

    def __init__(self):
        self.said: list[str] = []

    def message(self, text: str) -> None:
        """Keep a message."""
        self.said.append(text)


def run(quick: bool, out: Path, report: Report) -> Family:
    """Try all cases."""
    failures, figures = [], []
    names = QUICK if quick else tuple(CASES)
    for name in names:
        reason, figure = attempt(CASES[name], out / name.replace(" ", "_").replace("^", ""))
        figures.append({"case": name, **figure})
        report(f"hard_numbers: {name}: {reason or 'survived'} {figure}")
        if reason is not None:
            failures.append(Failure(name, reason))
    survived = len(names) - len(failures)
    return Family(NAME, len(names), survived, tuple(failures), figures=tuple(figures))


def attempt(case: Case, out: Path) -> tuple[str | None, dict[str, str | float]]:
    """Fit a case; return its fault or None, and its result."""
    heard = _Heard()
    cfg = with_fields(preset("robust"), OPTIONS | dict(case.options))
    scene = write_scene(out / "scene", case.made)
    try:
        with np.errstate(all="ignore"):
            found = fit(scene, out / "run", cfg, reporter=heard)
    except UserError as error:
        figure = NOTHING | {"outcome": "refused"}
        if not case.refused:
            return f"refused: {error}", figure
        missing = [word for word in case.says if word not in str(error)]
        return (f"it does not say {missing[0]!r}: {error}" if missing else None), figure
    except Exception as error:
        return f"{type(error).__name__}: {error}", NOTHING | {"outcome": "an error"}
    psnr = found.metrics["train"]["psnr"]
    views = json.loads((out / "run" / "photometry.json").read_text())["views"]
    unknown = [view["image"] for view in views if view.get("exposure_unknown")]
    figure = {
        "outcome": "fitted",
        "training PSNR dB": "" if psnr is None else round(psnr, 2),
        "unknown": len(unknown),
    }
    return _wrong(case, out / "run", heard.said, psnr, unknown, found.metrics), figure


def _wrong(
    case: Case, run: Path, said: list[str], psnr: float | None, unknown: list[str], metrics: dict
) -> str | None:
    if case.refused:
        return "it was fitted and not refused"
    missing = [word for word in case.says if word not in " ".join(said)]
    if missing:
        return f"it does not say {missing[0]!r}: {' '.join(said)[-300:]}"
    unsaid = set(case.unknown) - set(unknown) - set(metrics["test"].get("per_view", {}))
    held_out = {k for k in case.unknown if k not in unknown and k in _held_out(run)}
    if unsaid - held_out:
        return f"exposures not said to be unknown: {', '.join(sorted(unsaid - held_out))}"
    if case.least_db is not None and (psnr is None or psnr < case.least_db):
        return f"PSNR {psnr} dB, less than {case.least_db}"
    if psnr is not None and psnr >= 119:  # the score without a valid pixel
        return f"PSNR {psnr:.0f} dB: no pixel was compared"
    return _not_finite(run)


def _held_out(run: Path) -> set[str]:
    views = json.loads((run / "photometry.json").read_text())["views"]
    return {view["image"] for view in views if view["split"] == "test"}


def _not_finite(run: Path) -> str | None:
    """Return which values of a run are not finite, or None."""
    gaussians = read_ply(run / "radiance.ply")
    for name in ("means", "quats", "log_scales", "opacity_logits", "sh"):
        if not np.isfinite(np.asarray(getattr(gaussians, name))).all():
            return f"radiance.ply: {name} is not finite"
    for view in json.loads((run / "photometry.json").read_text())["views"]:
        if view["split"] == "train" and not math.isfinite(view["exposure"] or math.nan):
            return f"photometry.json: the exposure of {view['image']} is not finite"
    return None
