"""A sample of the other families, fitted for a few steps instead of only read."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from reliability.families import broken_models, broken_photographs, odd_names
from reliability.family import Family, Report
from reliability.reading import fit
from reliability.trials import Trial, run_trials

NAME = "short_fits"
ABOUT = """Every 100th trial of broken models, photographs and names, and some by name, through a
whole fit of 4 steps with its evaluation and files. Each is fitted, or refused with code 2 by a
message that names file, fault and remedy, within 120 s and 2 GB of resident memory."""
SPACING = 100
CHOSEN = frozenset(
    {
        "colmap whole (True)",
        "kind: CMYK.jpg",
        "kind: palette.png",
        "kind: animated.webp",
        "size: 1x1.png",
        "photograph: HTML",
        "photograph: ANSI colour",
        "photograph: unbalanced markup",
        "photograph: no UTF-8",
    }
)
SECONDS = 120.0
# XLA's compiler asks for address space that it does not use.
ADDRESSES = 8 * 2**30


def run(quick: bool, out: Path, report: Report) -> Family:
    """Try all; `quick`: every fourth."""
    return run_trials(NAME, list(trials())[:: 4 if quick else 1], out, report)


def trials() -> Iterator[Trial]:
    """Yield all, in their order."""
    for family in (broken_models, broken_photographs, odd_names):
        for number, trial in enumerate(family.trials()):
            if trial.name in CHOSEN or number % SPACING == SPACING // 2:
                refused = trial.refused if trial.refused is True else None
                yield replace(trial, act=fit, refused=refused, seconds=SECONDS, data=ADDRESSES)
