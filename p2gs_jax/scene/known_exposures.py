"""Exposures known beforehand: from a CSV file or from EXIF."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
from jaxtyping import Float

from p2gs_jax.core.numerics import LN2
from p2gs_jax.errors import UserError
from p2gs_jax.types import View

KINDS = ("ev", "exposure", "rel_exposure_ev", "exposure_time_s")


def read_known_exposures(source: str, views: list[View]) -> Float[np.ndarray, " v"]:
    """Return natural logarithms of known exposures, NaN where nothing is known.

    Args:
        source: `exif`, or a CSV file with a column `image` or `file` (name of the view, or its
            last part) and one of `ev`, `rel_exposure_ev` (stops), `exposure` (linear, > 0) or
            `exposure_time_s` (seconds).
        views: the views wanted, in order.

    Raises:
        UserError: the file cannot be used, or holds none of the views.
    """
    if source == "exif":
        values = _exif_ev(views) * LN2
        if not np.isfinite(values).any():
            raise UserError(
                "no photograph carries exposure time, f-number and ISO in its EXIF.",
                fix="give a CSV file to --known-exposures, or leave it out",
            )
        return values
    table = _read(Path(source))
    values = np.full(len(views), np.nan)
    for row, view in enumerate(views):
        value = table.get(view.name, table.get(Path(view.name).name))
        if value is not None:
            values[row] = value
    if not np.isfinite(values).any():
        example = views[0].name if views else "image.jpg"
        raise UserError(
            f"{source} names none of the {len(views)} training views.",
            fix=f"write names as the scene does, for example {example}",
        )
    return values


def check_source(source: str | None) -> None:
    """Check that a source can be used, before there are any views.

    Args:
        source: see `read_known_exposures`; None is fine.

    Raises:
        UserError: the file cannot be used.
    """
    if source not in (None, "exif"):
        _read(Path(source))


def stated_ev(source: str | None, views: list[View]) -> Float[np.ndarray, " v"]:
    """Return stated exposures in stops, up to a constant; NaN where nothing is stated.

    Args:
        source: see `read_known_exposures`; None takes EXIF where there is any.
        views: the views wanted, in order.

    Raises:
        UserError: see `read_known_exposures`.
    """
    if source is None:
        return _exif_ev(views)
    return read_known_exposures(source, views) / LN2


def _exif_ev(views: list[View]) -> Float[np.ndarray, " v"]:
    return np.array([np.nan if v.exif_ev is None else v.exif_ev for v in views], float)


def _read(path: Path) -> dict[str, float]:
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise UserError(
            f"{path} cannot be read: {reason}.",
            fix="name a CSV file with the columns image and ev, or say exif",
        ) from error
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    reader = csv.DictReader(lines)
    try:
        names = [n.strip() for n in reader.fieldnames or []]
        reader.fieldnames = names
        rows = list(reader)
    except csv.Error as error:
        raise UserError(f"{path} is no CSV file: {error}.", fix="write it again") from None
    kind = next((n for n in KINDS if n in names), None)
    name = next((n for n in ("image", "file") if n in names), None)
    if name is None or kind is None:
        raise UserError(
            f"{path} has the columns {', '.join(names) or 'none'}.",
            fix=f"it needs `image` and one of {', '.join(KINDS)}",
        )
    out = {}
    for number, row in enumerate(rows, 2):
        if not (row[kind] or "").strip():
            continue
        try:
            value = float(row[kind])
            log = (
                value * LN2
                if kind.endswith("ev")
                else float(np.log(value))
                if value > 0
                else np.nan
            )
        except ValueError:
            log = np.nan
        if not np.isfinite(log):
            raise UserError(
                f"{path}, line {number}: {kind} is {row[kind]!r}.",
                fix="write a finite number, above 0 for exposures",
            )
        out[(row[name] or "").strip()] = log
    return out
