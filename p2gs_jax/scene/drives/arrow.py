"""Tables in Arrow's files, Feather and Parquet: the columns that are wanted, and no others."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from p2gs_jax.errors import UserError, broken
from p2gs_jax.scene.drives.tables import missing_file


def read_feather(
    path: Path, numbers: Sequence[str], objects: Sequence[str] = ()
) -> dict[str, np.ndarray]:
    """Return columns of a Feather file; see `ParquetTable.columns`."""
    with _reading(path):
        from pyarrow import feather

        table = feather.read_table(path, memory_map=False)
        return _columns(table, path, numbers, objects)


class ParquetTable:
    """A Parquet file: short columns are read whole, long ones a group of rows at a time."""

    def __init__(self, path: Path):
        """Open it; UserError: pyarrow or the file is missing, or the file is broken."""
        self.path = path
        with _reading(path):
            from pyarrow import parquet

            self._file = parquet.ParquetFile(path)
        meta = self._file.metadata
        counts = [meta.row_group(group).num_rows for group in range(meta.num_row_groups)]
        self._ends = np.cumsum(counts, dtype=int)
        self._held: tuple[int, tuple[str, ...], Any] | None = None

    def columns(self, numbers: Sequence[str], objects: Sequence[str] = ()) -> dict[str, np.ndarray]:
        """Return columns by name: numbers, of which whole ones stay whole, and objects.

        Objects are texts or lists, None where there is nothing. UserError: a column is not there,
        or does not hold numbers, or the file is broken.
        """
        with _reading(self.path):
            table = self._file.read(columns=[*numbers, *objects])
            return _columns(table, self.path, numbers, objects)

    def cells(self, row: int, names: Sequence[str]) -> list[Any]:
        """Return cells of one row: lists of numbers as arrays, texts and bytes as they are.

        The group of rows that was read last is kept in memory. UserError: a column is not there, or
        the file is broken.
        """
        group = int(np.searchsorted(self._ends, row, side="right"))
        key = (group, tuple(names))
        if self._held is None or self._held[:2] != key:
            self._held = None
            with _reading(self.path):
                self._held = (*key, self._file.read_row_group(group, columns=list(names)))
        table = self._held[2]
        inside = row - int(self._ends[group]) + table.num_rows
        return [_cell(_column(table, name, self.path)[inside]) for name in names]


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Turn what goes wrong with pyarrow into errors that name the file."""
    try:
        import pyarrow
    except ImportError:
        raise UserError(
            "Argoverse 2 and Waymo write Arrow's files, and pyarrow is not installed",
            fix="pip install 'p2gs-jax[drives]'",
        ) from None
    if not path.is_file():
        raise missing_file(path)
    try:
        yield
    except (OSError, ValueError, pyarrow.ArrowException) as error:
        why = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise broken(path, f"cannot be read: {why}") from None


def _columns(table: Any, path: Path, numbers: Sequence[str], objects: Sequence[str]):
    found = {name: _numbers(_column(table, name, path), name, path) for name in numbers}
    for name in objects:
        values = _column(table, name, path).to_pylist()
        found[name] = np.empty(len(values), object)
        found[name][:] = values
    return found


def _column(table: Any, name: str, path: Path):
    if name not in table.column_names:
        raise broken(path, f"has no column {name!r}")
    return table[name]


def _numbers(column: Any, name: str, path: Path) -> np.ndarray:
    # Whole numbers with gaps would become float64, which time stamps do not fit into.
    gaps = column.null_count and not str(column.type).startswith(("float", "double", "half"))
    values = column.to_numpy()
    if gaps or values.dtype.kind not in "iuf":
        raise broken(f"{path}:", f"its column {name!r} should hold numbers, without gaps")
    return values


def _cell(scalar: Any) -> Any:
    if not scalar.is_valid:
        return None
    # Lists become arrays without a Python object for every number.
    if hasattr(scalar, "values"):
        return scalar.values.to_numpy(zero_copy_only=False)
    return scalar.as_py()
