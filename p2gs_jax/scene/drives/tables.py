"""Files of driving data sets: folders of drives, numbers, tables in JSON, Arrow and pickles.

A pickle names functions and calls them. Here each name that a table of numbers and texts needs
becomes a passive record with the arguments of the call, and other names are refused. The records
are then decoded, for all layouts since pandas 0.14.
"""

from __future__ import annotations

import gzip
import io
import json
import mmap
import pickle
import re
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, Int64

from p2gs_jax.core.text import first_few, parse_json
from p2gs_jax.errors import UserError, broken

Row = dict[str, Any]
Kinds = Mapping[str, type | tuple[type, ...]]

UNPACK = "unpack that part of the data set there as well"
_DECODER = json.JSONDecoder()
# The longest row of a large JSON table, bytes.
_LONGEST_ROW = 2**14
# Names in pickled tables, with the modules of old and new versions of pandas and numpy.
_IN_TABLES = re.compile(
    r"pandas(\.\w+)*\.(DataFrame|BlockManager|_unpickle_block|_new_Index|(Range|Int64)?Index)"
    r"|numpy\.(ndarray|dtype|_?core\.multiarray\._reconstruct|_?core\.numeric\._frombuffer)"
    r"|(builtins|__builtin__)\.slice"
)
# The largest unpacked table, 256 MiB; a sweep of PandaSet has 10 MB.
_MOST_BYTES = 2**28


PHOTOGRAPHS = (".jpg", ".jpeg", ".png")  # suffixes for `numbered`
UNPLACED_SWEEPS = "LiDAR sweeps have no time or pose: they are left out."  # for `counted`


def counted(count: int, words: str) -> list[str]:
    """Return the note `COUNT WORDS`, or no note if the count is 0."""
    return [f"{count} {words}"] if count else []


def drive_folder(root: Path, wanted: str | None, marker: str) -> Path:
    """Return the folder of a drive: `root`, or the subfolder with the name `wanted`.

    The glob `marker` finds a file in the folder of a drive. UserError: `root` is another drive, or
    see `chosen_drive`.
    """
    if any(root.glob(marker)):
        names = root.name, root.resolve().name
        if wanted is not None and not any(wanted in name for name in names):
            why = f"{root} is one drive, whose name does not contain {wanted!r}."
            raise UserError(why, fix="leave out --drive, or name the folder of all drives")
        return root
    drives = {path.relative_to(root).parts[0] for path in root.glob(f"*/{marker}")}
    return root / chosen_drive(wanted, sorted(drives), root)


def chosen_drive(wanted: str | None, there: Sequence[str], root: Path) -> str:
    """Return the drive in `root` whose name is or begins with `wanted`; None: the only drive.

    UserError: no drive has this name, or several begin with it.
    """
    fits = [name for name in there if wanted is None or name.startswith(wanted)]
    fits = [name for name in fits if name == wanted] or fits
    if len(fits) == 1:
        return fits[0]
    names = first_few(sorted(fits or there))
    if wanted is None:
        message = f"{root} holds {len(there)} drives: {names}"
    elif fits:
        message = f"{len(fits)} drives of {root} begin with {wanted!r}: {names}"
    else:
        message = f"{root} holds no drive {wanted!r}; there are {names or 'none'}"
    raise UserError(message, fix="name one of them: --drive NAME")


def read_lines(path: Path) -> list[str]:
    """Return the lines of a text; UserError: it is missing."""
    try:
        return path.read_text("utf-8-sig", "replace").rstrip().splitlines()
    except FileNotFoundError:
        raise broken(path, "does not exist", UNPACK) from None


def read_scan(path: Path, columns: int, what: str) -> Float32[np.ndarray, "n c"]:
    """Return the rows of a LiDAR scan; UserError: its size is wrong; `what` names the layout."""
    values = np.fromfile(path, "<f4")
    if values.size % columns or path.stat().st_size % values.itemsize:
        raise broken(path, f"is not a LiDAR {what}")
    return values.reshape(-1, columns)


def box_size(sides: Iterable[Any], path: Path, box: str = "a box") -> tuple[float, float, float]:
    """Return the sides of a box in their order; UserError: they are not three positive numbers."""
    first, second, third = finite_numbers(sides, path, f"the size of {box}", 3).tolist()
    if min(first, second, third) <= 0:
        raise broken(f"{path}:", f"{box} has a side of 0 m")
    return first, second, third


def finite_numbers(
    values: Iterable[Any], path: Path, what: str, count: int | None = None
) -> Float64[np.ndarray, " n"]:
    """Return numbers, which may be texts, as an array.

    `what` names them in a message. UserError: a number is not finite, or there are not `count`.
    """
    try:
        numbers = np.array([float(value) for value in values])
    except (TypeError, ValueError):
        numbers = np.array([np.nan])
    if not np.isfinite(numbers).all() or count not in (None, len(numbers)):
        many = "finite numbers" if count is None else f"{count} finite numbers"
        raise broken(f"{path}:", f"{what} should be {many}")
    return numbers


def numbered(folder: Path, suffixes: tuple[str, ...]) -> dict[int, Path]:
    """Return the files of a folder whose names are a number and a suffix, by rising number.

    The folder may be absent. Suffixes include dots (".pkl.gz") and fit in any case; the first that
    fits counts.
    """
    found: dict[int, Path] = {}
    for path in sorted(folder.iterdir()) if folder.is_dir() else ():
        name = path.name.lower()
        stem = next((name.removesuffix(end) for end in suffixes if name.endswith(end)), "")
        if stem.isdecimal():
            found.setdefault(int(stem), path)
    return dict(sorted(found.items()))


def read_rows(path: Path, needs: Kinds, column: str = "", among: Container[Any] = ()) -> list[Row]:
    """Return rows of a large JSON list of objects; only the wanted rows are decoded.

    The tables of nuScenes have millions of rows. The rows of one drive are searched in the file,
    which is not held in memory: rows whose text in `column` is in `among`, or all rows if `column`
    is empty. Rows must not contain objects. UserError: the file is missing, not a list of objects,
    or cut off, or a row lacks a column of `needs` or has another type there.
    """
    try:
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as text:
            if not (
                re.match(rb"(?:\xef\xbb\xbf)?\s*\[\s*[{\]]", text)
                and re.search(rb"[}\[]\s*]\s*$", text[-999:])
            ):
                raise ValueError("it should be a list of objects")
            every = "" if column else text[:].decode("utf-8-sig")
            rows = list(_found(text, column, among)) if column else parse_json(every)
    except FileNotFoundError:
        raise broken(path, "does not exist", UNPACK) from None
    except (ValueError, RecursionError) as error:
        raise broken(path, f"is not a valid table: {error}") from None
    for row in rows:
        for name, kind in needs.items():
            if not (isinstance(row, dict) and isinstance(row.get(name), kind)):
                why = f"a row has no valid {name!r}: {json.dumps(row)[:200]}"
                raise broken(path, f"is not a valid table: {why}")
    return rows


def _found(text: mmap.mmap, column: str, among: Container[Any]) -> Iterator[Row]:
    """Yield the rows with one of the values; rows must not contain objects."""
    for match in re.finditer(rf'"{re.escape(column)}"\s*:\s*"([^"]*)"'.encode(), text):
        if match[1].decode() in among:
            start = text.rfind(b"{", 0, match.start())
            row = text[start : start + _LONGEST_ROW].decode(errors="replace")
            yield _DECODER.raw_decode(row)[0]


class Columns(dict[str, np.ndarray]):
    """Columns of a table by name; a missing column raises UserError.

    Columns of other values than numbers hold objects; their empty cells are None.
    """

    def __init__(self, columns: Mapping[str, np.ndarray], path: Path):
        super().__init__(columns)
        self.path = path

    def __missing__(self, name: str):
        raise broken(self.path, f"has no column {name!r}, only {', '.join(self)}")

    def numbers(self, name: str) -> Float64[np.ndarray, " n"]:
        """Return a column of numbers; UserError: it holds something else."""
        if self[name].dtype.kind not in "biuf":
            raise broken(f"{self.path}:", f"the column {name!r} does not hold numbers")
        return self[name].astype(np.float64)

    def stacked(self, names: Iterable[str]) -> Float64[np.ndarray, "n k"]:
        """Return columns of numbers side by side; UserError: a column holds something else."""
        return np.stack([self.numbers(name) for name in names], 1)

    def whole(self, name: str) -> Int64[np.ndarray, " n"]:
        """Return a column of whole numbers; UserError: it holds others, or has gaps."""
        if self[name].dtype.kind not in "iu":
            raise broken(f"{self.path}:", f"{name} does not hold whole numbers without gaps")
        return self[name].astype(np.int64)


def read_feather(path: Path, names: Sequence[str]) -> Columns:
    """Return columns of a Feather file; UserError: a column is missing, or the file is broken."""
    with _reading(path):
        from pyarrow import feather

        return _arrow_columns(feather.read_table(path, memory_map=False), names, path)


class ParquetTable:
    """A Parquet file: `columns` reads whole columns, `cells` one group of rows at a time."""

    def __init__(self, path: Path):
        """Open the file; UserError: pyarrow or the file is missing, or the file is broken."""
        self.path = path
        with _reading(path):
            from pyarrow import parquet

            self._file = parquet.ParquetFile(path)
        meta = self._file.metadata
        counts = [meta.row_group(group).num_rows for group in range(meta.num_row_groups)]
        self._ends = np.cumsum(counts, dtype=int)
        self._group: tuple[int, Sequence[str], Any] | None = None

    def columns(self, names: Sequence[str]) -> Columns:
        """Return columns by name; UserError: a column is missing, or the file is broken."""
        with _reading(self.path):
            return _arrow_columns(self._file.read(columns=list(names)), names, self.path)

    def cells(self, row: int, names: Sequence[str]) -> list[Any]:
        """Return cells of one row: lists of numbers as arrays, texts and bytes unchanged.

        The group of rows stays in memory until another one is read. UserError: a column is missing,
        or the file is broken.
        """
        group = int(np.searchsorted(self._ends, row, side="right"))
        if self._group is None or self._group[:2] != (group, names):
            self._group = None
            with _reading(self.path):
                table = self._file.read_row_group(group, columns=list(names))
            self._group = group, names, table
        table = self._group[2]
        inside = row - int(self._ends[group]) + table.num_rows
        cells = _arrow_columns(table.slice(inside, 1), names, self.path)
        return [cells[name][0] for name in names]


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Turn the errors of pyarrow into errors that name the file."""
    try:
        import pyarrow
    except ImportError:
        why = "Argoverse 2 and Waymo write Arrow's files, and pyarrow is not installed"
        raise UserError(why, fix="pip install 'p2gs-jax[drives]'") from None
    if not path.is_file():
        raise broken(path, "does not exist", UNPACK)
    try:
        yield
    except (OSError, ValueError, pyarrow.ArrowException) as error:
        why = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise broken(path, f"cannot be read: {why}") from None


def _arrow_columns(table: Any, names: Sequence[str], path: Path) -> Columns:
    found = {name: table[name] for name in names if name in table.column_names}
    # pyarrow would return NaN for a column without values.
    empty = np.full(len(table), None)
    values = {n: empty if str(c.type) == "null" else c.to_numpy() for n, c in found.items()}
    return Columns(values, path)


class _Record:
    """The arguments with which a pickle calls a name, and the state that it sets."""

    name = ""
    args: tuple
    state: Any

    def __new__(cls, *args):
        made = super().__new__(cls)
        made.args, made.state = args, None
        return made

    def __setstate__(self, state):
        self.state = state


class _Records(pickle.Unpickler):
    """Reads a pickle as a tree of plain values and records."""

    def find_class(self, module: str, name: str):
        if not _IN_TABLES.fullmatch(f"{module}.{name}"):
            raise pickle.UnpicklingError(f"it holds a {module}.{name}")
        return type(name, (_Record,), {"name": name})


def read_pickled(path: Path) -> Columns:
    """Return the columns of a pickled table (.pkl or .pkl.gz); texts are objects.

    UserError: the file is missing, damaged, or not a table of numbers and texts.
    """
    try:
        content = path.read_bytes()
        if content[:2] == b"\x1f\x8b":
            with gzip.open(io.BytesIO(content)) as packed:
                content = packed.read(_MOST_BYTES + 1)
            if len(content) > _MOST_BYTES:
                raise ValueError(f"it unpacks to more than {_MOST_BYTES >> 20} MiB")
        return Columns(_columns(_Records(io.BytesIO(content)).load()), path)
    except FileNotFoundError:
        raise broken(path, "does not exist", UNPACK) from None
    # A damaged pickle may raise any error.
    except Exception as error:
        fix = "get the file again; tables are pickled pandas DataFrames of numbers and texts"
        raise broken(path, f"is not a table that can be read: {error}", fix) from error


def _columns(table: Any) -> dict[str, np.ndarray]:
    if not isinstance(table, _Record) or table.name != "DataFrame":
        raise ValueError("its content is not a DataFrame")
    manager = table.state.get("_mgr", table.state.get("_data"))
    if manager.args:
        blocks, axes = manager.args[:2]
        blocks = [block.args[:2] for block in blocks]
    else:
        # Up to pandas 1.2, the last entry of the state holds the layout of version 0.14.1.
        state = manager.state[3]["0.14.1"]
        blocks, axes = [(b["values"], b["mgr_locs"]) for b in state["blocks"]], state["axes"]
    names, rows = map(_array, axes)
    labels = [str(name) for name in names]
    columns: dict[str, np.ndarray] = {}
    for values, places in blocks:
        if isinstance(places, _Record) and places.name == "slice":
            where = list(range(*slice(*places.args).indices(len(labels))))
        else:
            where = [int(place) for place in _array(places)]
        for row, place in zip(_array(values).reshape(len(where), len(rows)), where, strict=True):
            columns[labels[place]] = row
    if len(columns) != len(labels):
        raise ValueError(f"{len(columns)} of {len(labels)} columns have values")
    return {label: columns[label] for label in labels}


def _array(record: Any) -> np.ndarray:
    name = record.name if isinstance(record, _Record) else type(record).__name__
    if name == "_new_Index":
        kind, state = record.args
        if kind.name == "RangeIndex":
            return np.arange(state["start"], state["stop"], state["step"])
        return _array(state["data"])
    if name == "_reconstruct":
        _, shape, dtype, fortran, data = record.state
        order = "F" if fortran else "C"
    elif name == "_frombuffer":
        data, dtype, shape, order = record.args[:4]
    else:
        raise ValueError(f"a {name} where an array was expected")
    kind, byte_order = dtype.args[0], dtype.state[1]
    if kind[0] not in "biufO" or len(kind) > 3:
        raise ValueError(f"values of type {kind}")
    if kind[0] == "O":
        values = np.empty(len(data), object)
        values[:] = data
    else:
        values = np.frombuffer(bytes(data), np.dtype(kind).newbyteorder(byte_order))
    return values.reshape(shape, order=order)
