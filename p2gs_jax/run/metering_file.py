"""`metering.json`: what the meters read in the training views, and which rule explains them."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import numpy as np

from p2gs_jax.core.atomic import write_json
from p2gs_jax.core.json_text import parse_json
from p2gs_jax.errors import UserError
from p2gs_jax.photometry.metering import METERS, Metering, Rule


def write_metering(path: Path, metering: Metering) -> None:
    """Write the file atomically."""
    rows = zip(metering.names, metering.readings.tolist(), strict=True)
    write_json(
        path,
        {
            "said": metering.sentence,
            "rule": asdict(metering.rule),
            "candidates": [asdict(rule) for rule in metering.candidates],
            "white": metering.white,
            "readings": {name: dict(zip(METERS, row, strict=True)) for name, row in rows},
        },
    )


def read_metering(path: Path) -> Metering | None:
    """Read the file; None where there is none, as in runs of older versions.

    Raises:
        UserError: it is no such file.
    """
    if not path.is_file():
        return None
    try:
        data = parse_json(path.read_text(encoding="utf-8"))
        readings = data["readings"]
        values = [[row[name] for name in METERS] for row in readings.values()]
        table = np.array(values, np.float64).reshape(-1, len(METERS))
        candidates = tuple(map(_rule, data["candidates"]))
        if not any(not rule.meters for rule in candidates):
            raise ValueError("no constant")
        white = float(data["white"])
        return Metering(_rule(data["rule"]), candidates, white, tuple(readings), table)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise UserError(
            f"{path} cannot be read: {error!r}.", fix="remove it: it is then computed again"
        ) from error


def _rule(data: dict) -> Rule:
    numbers = (data["offset"], data["residual_ev"], data["left_out_ev"])
    offset, residual, left_out = (float("nan") if v is None else float(v) for v in numbers)
    return Rule(tuple(data["meters"]), tuple(data["slopes"]), offset, residual, left_out)
