"""Known exposures from a CSV file or EXIF, and the views to which names in a file refer."""

from __future__ import annotations

import csv
import re
from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import Float

from p2gs_jax.core.numerics import LN2
from p2gs_jax.core.text import first_few, read_csv
from p2gs_jax.errors import UserError, broken
from p2gs_jax.options import MOST_STOPS
from p2gs_jax.types import View

KINDS = ("ev", "exposure", "rel_exposure_ev", "exposure_time_s")


def read_known_exposures(
    source: str,
    views: Sequence[View],
    among: Sequence[View] = (),
    option: str = "--known-exposures",
) -> Float[np.ndarray, " v"]:
    """Return natural logarithms of known exposures of views, and NaN for unknown ones.

    The source is `exif` (EXIF, or exposures that the data set states), or a CSV file with a column
    `image` or `file` (the view's name, or any end of its path) and one of `ev`, `rel_exposure_ev`
    (stops), `exposure` (linear, > 0) or `exposure_time_s` (seconds). Names in the file may mean any
    view in `among` (all views of the scene; by default `views`). Raises UserError with the `option`
    in its remedy: the source cannot be used, names none of the views, or a name is ambiguous.
    """
    if source == "exif":
        values = _exif_ev(views) * LN2
        if not np.isfinite(values).any():
            why = "no photograph carries an exposure time or ISO in its EXIF, and the data set "
            why += "states no exposures."
            raise UserError(why, fix=f"give a CSV file to {option}, or leave it out")
        return values
    table = _by_view(_read(Path(source)), among or views, source)
    values = np.array([table.get(view.name, np.nan) for view in views], float)
    if not np.isfinite(values).any():
        example = views[0].name if views else "image.jpg"
        why = f"names none of the {len(views)} training views."
        raise broken(source, why, f"write names as the scene does, for example {example}")
    return values


def without_view(source: str, views: Sequence[View]) -> tuple[str, ...]:
    """Return the names in the CSV file `source` that mean no view; none for `exif`."""
    row_of = row_finder(views, source)
    names = () if source == "exif" else _read(Path(source))
    return tuple(name for name in names if row_of(name) is None)


def strangers(source: str | None, views: Sequence[View]) -> list[str]:
    """Return a note if names in a source of `stated_ev` mean no view."""
    names = () if source is None else without_view(source, views)
    note = f"{len(names)} exposures of {source} belong to no view: {first_few(names)}."
    return [note] if names else []


def _by_view(table: dict[str, float], views: Sequence[View], source: str) -> dict[str, float]:
    """Return the values in a table of any names by the full names of their views."""
    row_of, out = row_finder(views, source), dict[str, float]()
    for name, value in table.items():
        row = row_of(name)
        if row is not None and out.setdefault(views[row].name, value) != value:
            why = f"{views[row].name} has two exposures"
            raise broken(f"{source}:", why, "remove one of them")
    return out


def plain_name(name: str) -> str:
    """Return a name with forward slashes and without parts `.`, equal on every system."""
    return PurePosixPath(name.replace("\\", "/")).as_posix()


def row_finder(views: Sequence[View], source: object) -> Callable[[str], int | None]:
    """Return a function that maps a name in the file `source` to the row of its view, or None.

    A name is any end of the photograph's path, with or without the suffix. The function raises
    UserError if a name is ambiguous.
    """
    rows_of: dict[str, set[int]] = defaultdict(set)
    # The path of a converted photograph differs from its name.
    paths = [(row, p) for row, v in enumerate(views) for p in (v.image_path, PurePosixPath(v.name))]
    for row, path in paths:
        parts = path.as_posix().lstrip("/").split("/")
        for tail in ("/".join(parts[start:]) for start in range(len(parts))):
            rows_of[tail].add(row)
            rows_of[tail.removesuffix(path.suffix)].add(row)

    def find(name: str) -> int | None:
        normal = plain_name(name)
        rows = rows_of.get(normal.lstrip("/"), set())
        names = {row: views[row].name for row in rows}
        exact = {row for row, n in names.items() if normal in (n, n.removesuffix(Path(n).suffix))}
        rows = exact if len(exact) == 1 else rows
        if len(rows) > 1:
            both = " and ".join(views[row].name for row in sorted(rows)[:2])
            raise broken(f"{source}:", f"{name} may be {both}", "write more of its path")
        return next(iter(rows), None)

    return find


def check_source(source: str | None) -> None:
    """Raise UserError if a source of `read_known_exposures` cannot be used; None is accepted."""
    if source not in (None, "exif"):
        _read(Path(source))


def stated_ev(source: str | None, views: Sequence[View]) -> Float[np.ndarray, " v"]:
    """Return exposures in stops up to a constant, or NaN; the source None stands for EXIF."""
    if source is None:
        return _exif_ev(views)
    return read_known_exposures(source, views, option="--compare-with") / LN2


def _exif_ev(views: Sequence[View]) -> Float[np.ndarray, " v"]:
    return np.array([np.nan if v.exif_ev is None else v.exif_ev for v in views], float)


def _read(path: Path) -> dict[str, float]:
    """Return the natural logarithms of the exposures in a CSV file, by name."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        why = f"cannot be read: {getattr(error, 'strerror', None) or error}."
        fix = "name a CSV file with the columns image and ev, or exif"
        raise broken(path, why, fix) from error
    # The name of a photograph may begin with #; a comment has no comma, or a space after the #.
    comment = re.compile(r"#( |[^,]*$)")
    lines = ["" if comment.match(line) else line.strip() for line in text.splitlines()]
    try:
        names, rows = read_csv(path, lines)
    except csv.Error as error:
        raise broken(path, f"is not a CSV file: {error}.", "write it again") from None
    kind = next((n for n in KINDS if n in names), None)
    name = next((n for n in ("image", "file") if n in names), None)
    if name is None or kind is None:
        why = f"has the columns {', '.join(names) or 'none'}."
        raise broken(path, why, f"it needs `image` and one of {', '.join(KINDS)}")
    out = {}
    for number, row in rows:
        if not (text := row.get(kind, "")).strip():
            continue
        try:
            value = float(text)
        except ValueError:
            value = np.nan
        if not kind.endswith("ev"):
            log = float(np.log(value)) if value > 0 else np.nan
        else:
            log = value * LN2
        if not np.isfinite(log):
            fix = "write a finite number, above 0 for exposures"
            raise broken(f"{path}, line {number}:", f"{kind} is {text!r}.", fix)
        if out.setdefault(image := row.get(name, "").strip(), log) != log:
            fix = "keep only one of its lines"
            raise broken(f"{path}, line {number}:", f"{image} has two exposures", fix)
    mean = float(np.mean([*out.values()])) if out else 0.0
    image = max(out, key=lambda image: abs(out[image] - mean), default="")
    if image and abs(stops := (out[image] - mean) / LN2) > MOST_STOPS:
        why = f"the exposure of {image} is {stops:+g} stops from the mean"
        raise broken(f"{path}:", why, f"write exposures within {MOST_STOPS:g} stops of the mean")
    return out
