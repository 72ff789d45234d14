"""Tables in Arrow's files, Feather and Parquet: the columns that are wanted, and no others."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from p2gs_jax.errors import UserError, broken
from p2gs_jax.scene.drives.tables import Columns, missing_file


def read_feather(path: Path, names: Sequence[str]) -> Columns:
    """Return columns of a Feather file; UserError: one is not there, or the file is broken."""
    with _reading(path):
        from pyarrow import feather

        return _columns(feather.read_table(path, memory_map=False), names, path)


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
        self._held: tuple[int, Sequence[str], Any] | None = None

    def columns(self, names: Sequence[str]) -> Columns:
        """Return columns by name; UserError: one is not there, or the file is broken."""
        with _reading(self.path):
            return _columns(self._file.read(columns=list(names)), names, self.path)

    def cells(self, row: int, names: Sequence[str]) -> list[Any]:
        """Return cells of one row: lists of numbers as arrays, texts and bytes as they are.

        The group of rows that was read last is kept in memory. UserError: a column is not there, or
        the file is broken.
        """
        group = int(np.searchsorted(self._ends, row, side="right"))
        if self._held is None or self._held[:2] != (group, names):
            self._held = None
            with _reading(self.path):
                table = self._file.read_row_group(group, columns=list(names))
            self._held = group, names, table
        table = self._held[2]
        inside = row - int(self._ends[group]) + table.num_rows
        cells = _columns(table.slice(inside, 1), names, self.path)
        return [cells[name][0] for name in names]


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


def _columns(table: Any, names: Sequence[str], path: Path) -> Columns:
    there = {name: table[name] for name in names if name in table.column_names}
    # What is nowhere given would come as NaN.
    nothing = np.full(len(table), None)
    values = {n: nothing if str(c.type) == "null" else c.to_numpy() for n, c in there.items()}
    return Columns(values, path)
