"""Tables in Arrow's files, Feather and Parquet: the columns that are wanted, and no others."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from p2gs_jax.errors import UserError
from p2gs_jax.scene.drives.tables import missing_file


def read_feather(
    path: Path, numbers: Sequence[str], texts: Sequence[str] = ()
) -> dict[str, np.ndarray]:
    """Return columns of a Feather file.

    Args:
        path: the file.
        numbers: columns of numbers; whole ones stay whole.
        texts: columns of anything, as objects; None where there is nothing.

    Raises:
        UserError: pyarrow or the file is missing, the file is broken or lacks a column.
    """
    pyarrow = _pyarrow()
    from pyarrow import feather

    if not path.is_file():
        raise missing_file(path)
    try:
        table = feather.read_table(path, memory_map=False)
    except (OSError, pyarrow.ArrowException) as error:
        raise _broken(path, error) from None
    columns = {name: _column(table, name, path) for name in (*numbers, *texts)}
    return {
        name: _numbers(column, name, path) if name in numbers else _objects(column)
        for name, column in columns.items()
    }


class ParquetTable:
    """A Parquet file: short columns are read whole, long ones a group of rows at a time."""

    def __init__(self, path: Path):
        """Open it.

        Raises:
            UserError: pyarrow or the file is missing, or the file is broken.
        """
        self.path = path
        self._pyarrow = _pyarrow()
        from pyarrow import parquet

        if not path.is_file():
            raise missing_file(path)
        try:
            self._file = parquet.ParquetFile(path)
        except (OSError, self._pyarrow.ArrowException) as error:
            raise _broken(path, error) from None
        meta = self._file.metadata
        counts = [meta.row_group(group).num_rows for group in range(meta.num_row_groups)]
        self._ends = np.cumsum(counts, dtype=int)
        self._held: tuple[int, tuple[str, ...], Any] | None = None

    def numbers(self, names: Sequence[str]) -> dict[str, np.ndarray]:
        """Return columns of numbers; whole ones stay whole.

        Raises:
            UserError: one is not there, or holds something else, or the file is broken.
        """
        table = self._read(lambda: self._file.read(columns=list(names)))
        return {name: _numbers(_column(table, name, self.path), name, self.path) for name in names}

    def objects(self, names: Sequence[str]) -> dict[str, np.ndarray]:
        """Return columns of texts or lists, as objects; None where there is nothing.

        Raises:
            UserError: one is not there, or the file is broken.
        """
        table = self._read(lambda: self._file.read(columns=list(names)))
        return {name: _objects(_column(table, name, self.path)) for name in names}

    def cells(self, row: int, names: Sequence[str]) -> dict[str, Any]:
        """Return cells of one row: lists of numbers as arrays, texts and bytes as such.

        Those of the group of rows that was read last come from memory.

        Raises:
            UserError: a column is not there, or the file is broken.
        """
        group = int(np.searchsorted(self._ends, row, side="right"))
        key = (group, tuple(names))
        if self._held is None or self._held[:2] != key:
            self._held = None
            table = self._read(lambda: self._file.read_row_group(group, columns=list(names)))
            self._held = (*key, table)
        table = self._held[2]
        inside = row - int(self._ends[group]) + table.num_rows
        return {name: _cell(_column(table, name, self.path)[inside]) for name in names}

    def _read(self, read) -> Any:
        try:
            return read()
        except (OSError, self._pyarrow.ArrowException) as error:
            raise _broken(self.path, error) from None


def _cell(scalar) -> Any:
    if not scalar.is_valid:
        return None
    # Lists become arrays without a Python object for every number.
    return (
        scalar.values.to_numpy(zero_copy_only=False)
        if hasattr(scalar, "values")
        else scalar.as_py()
    )


def _pyarrow():
    try:
        import pyarrow
    except ImportError:
        raise UserError(
            "Argoverse 2 and Waymo write Arrow's files, and pyarrow is not installed",
            fix="pip install 'p2gs-jax[drives]'",
        ) from None
    return pyarrow


def _broken(path: Path, error: Exception) -> UserError:
    why = str(error).splitlines()[0] if str(error) else type(error).__name__
    return UserError(f"{path} cannot be read: {why}", fix="get the file again; it may be cut off")


def _column(table, name: str, path: Path):
    if name not in table.column_names:
        raise UserError(
            f"{path} has no column {name!r}",
            fix="get the file again; it may be of another version of the data set",
        )
    return table[name]


def _numbers(column, name: str, path: Path) -> np.ndarray:
    # Whole numbers with gaps would become float64, which time stamps do not fit into.
    gaps = column.null_count and not str(column.type).startswith(("float", "double", "half"))
    values = column.to_numpy()
    if gaps or values.dtype.kind not in "iuf":
        raise UserError(
            f"{path}: its column {name!r} should hold numbers, without gaps",
            fix="get the file again",
        )
    return values


def _objects(column) -> np.ndarray:
    out = np.empty(len(column), object)
    out[:] = column.to_pylist()
    return out
