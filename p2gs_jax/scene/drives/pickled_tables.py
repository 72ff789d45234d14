"""Pickled pandas tables as columns of numpy arrays, without pandas and without running anything.

A pickle names functions and calls them. Here every name that a table of numbers and strings may
hold stands for an inert record of what it was called with; other names are refused. What the
records mean is worked out afterwards, for the layouts that pandas wrote from 0.14 to 3.
"""

from __future__ import annotations

import gzip
import io
import pickle
from pathlib import Path
from typing import Any

import numpy as np

from p2gs_jax.errors import UserError


class _Record:
    """What one name was called with, and the state it was given."""

    name = ""
    args: tuple
    state: Any

    def __new__(cls, *args):
        made = super().__new__(cls)
        made.args, made.state = args, None
        return made

    def __setstate__(self, state):
        self.state = state


# The last part of the name decides what it is; modules moved between versions.
_PANDAS = ("pandas", "pandas.arrays", "pandas._libs.", "pandas.core.")
_NAMES = {
    "DataFrame": _PANDAS,
    "BlockManager": _PANDAS,
    "_unpickle_block": _PANDAS,
    "_new_Index": _PANDAS,
    "Index": _PANDAS,
    "RangeIndex": _PANDAS,
    "Int64Index": _PANDAS,
    "StringArray": _PANDAS,
    "ArrowStringArray": _PANDAS,
    "StringDtype": _PANDAS,
    "__pyx_unpickle_NDArrayBacked": _PANDAS,
    "_restore_array": ("pyarrow.lib",),
    "type_for_alias": ("pyarrow.lib",),
    "py_buffer": ("pyarrow.lib",),
    "ndarray": ("numpy",),
    "dtype": ("numpy",),
    "_reconstruct": ("numpy.core.multiarray", "numpy._core.multiarray"),
    "scalar": ("numpy.core.multiarray", "numpy._core.multiarray"),
    "_frombuffer": ("numpy.core.numeric", "numpy._core.numeric"),
    "encode": ("_codecs",),
    "bytes": ("builtins", "__builtin__"),
    "bytearray": ("builtins", "__builtin__"),
    "slice": ("builtins", "__builtin__"),
}


# A sweep of PandaSet takes 10 MB.
_MOST_BYTES = 2**28


class _Records(pickle.Unpickler):
    """Reads a pickle as a tree of plain values and records."""

    def find_class(self, module: str, name: str):
        allowed = _NAMES.get(name, ())
        if not any(module == m or (m.endswith(".") and module.startswith(m)) for m in allowed):
            raise pickle.UnpicklingError(f"it holds a {module}.{name}, no table")
        return type(name, (_Record,), {"name": name})


def read_table(path: Path) -> dict[str, np.ndarray]:
    """Return the columns of a pickled table, by name; strings as arrays of objects.

    Args:
        path: a .pkl, or .pkl.gz.

    Raises:
        UserError: it is missing or damaged, or holds anything but a table of numbers and strings.
    """
    try:
        content = path.read_bytes()
        if content[:2] == b"\x1f\x8b":
            with gzip.open(io.BytesIO(content)) as packed:
                content = packed.read(_MOST_BYTES + 1)
            if len(content) > _MOST_BYTES:
                raise ValueError(f"it unpacks to more than {_MOST_BYTES >> 20} MiB")
        columns = _columns(_Records(io.BytesIO(content)).load())
    except FileNotFoundError:
        raise UserError(f"{path} is missing", fix="get the data set's archive again") from None
    # A damaged pickle ends in whatever its bytes happen to ask for.
    except Exception as error:
        raise UserError(
            f"{path} holds no table that can be read: {error}",
            fix="get the file again; tables are pandas DataFrames of numbers and strings, pickled",
        ) from error
    return columns


def _columns(table: Any) -> dict[str, np.ndarray]:
    if not isinstance(table, _Record) or table.name != "DataFrame":
        raise ValueError("its content is no DataFrame")
    manager = table.state.get("_mgr", table.state.get("_data"))
    blocks, (names, rows) = _blocks(manager)
    labels, count = [str(name) for name in _array(names)], len(_array(rows))
    columns: dict[str, np.ndarray] = {}
    for values, places in blocks:
        values = _array(values)
        where = _places(places, len(labels))
        # Blocks of strings may be one column without the axis of columns.
        for row, place in zip(values.reshape(len(where), count), where, strict=True):
            columns[labels[place]] = row
    if len(columns) != len(labels):
        raise ValueError(f"of {len(labels)} columns {len(columns)} are there")
    return {label: columns[label] for label in labels}


def _blocks(manager: _Record) -> tuple[list[tuple[Any, Any]], tuple[Any, Any]]:
    """Return pairs of values and columns, and the axes: names of columns, rows."""
    if manager.args:
        blocks, axes = manager.args[:2]
        return [(b.args[0], b.args[1]) for b in blocks], tuple(axes)
    # Until pandas 1.2: the last entry of the state holds what versions from 0.14.1 on read.
    held = manager.state[3]["0.14.1"]
    return [(b["values"], b["mgr_locs"]) for b in held["blocks"]], tuple(held["axes"])


def _places(places: Any, count: int) -> range | list[int]:
    if isinstance(places, _Record) and places.name == "slice":
        return range(*slice(*places.args).indices(count))
    return [int(place) for place in _array(places)]


def _array(held: Any) -> np.ndarray:
    """Return the array that a record stands for."""
    if not isinstance(held, _Record):
        raise ValueError(f"a {type(held).__name__} where an array was expected")
    if held.name == "_reconstruct":
        _, shape, dtype, fortran, data = held.state
        order = "F" if fortran else "C"
        return _filled(data, _dtype(dtype), shape, order)
    if held.name == "_frombuffer":
        data, dtype, shape, order = held.args[:4]
        return _filled(data, _dtype(dtype), shape, order)
    if held.name == "_new_Index":
        kind, state = held.args
        if kind.name == "RangeIndex":
            return np.arange(state["start"], state["stop"], state["step"])
        return _array(state["data"])
    if held.name == "__pyx_unpickle_NDArrayBacked":
        return _array(next(x for x in held.state if getattr(x, "name", "") == "_reconstruct"))
    if held.name == "StringArray":
        return _array(held.state["_ndarray"])
    if held.name == "ArrowStringArray":
        return _arrow_strings(held.state["_pa_array"])
    raise ValueError(f"a {held.name} where an array was expected")


def _filled(data: Any, dtype: np.dtype, shape: tuple[int, ...], order: Any) -> np.ndarray:
    if dtype.hasobject:
        values = np.empty(len(data), object)
        values[:] = [_scalar(value) for value in data]
    else:
        values = np.frombuffer(_bytes(data), dtype)
    return values.reshape(shape, order=order)


def _scalar(value: Any) -> Any:
    if isinstance(value, _Record):
        dtype, data = value.args
        return np.frombuffer(_bytes(data), _dtype(dtype))[0]
    return value


def _dtype(record: _Record) -> np.dtype:
    """Return a type of plain numbers, or of objects."""
    name, order = record.args[0], record.state[1]
    if name[0] not in "biufOM" or len(name) > 3:
        raise ValueError(f"values of type {name}")
    if name[0] == "M":
        # Their unit does not matter here: no column that is used holds dates.
        return np.dtype("i8").newbyteorder(order)
    return np.dtype(object) if name[0] == "O" else np.dtype(name).newbyteorder(order)


def _bytes(data: Any) -> bytes:
    """Return raw bytes; old protocols write them as text."""
    if isinstance(data, _Record):
        if data.name == "encode":
            return data.args[0].encode("latin1")
        return _bytes(data.args[0]) if data.args else b""
    return data.encode("latin1") if isinstance(data, str) else bytes(data)


def _arrow_strings(held: _Record) -> np.ndarray:
    """Return strings that pandas 3 keeps in Arrow's layout: validity bits, offsets, text."""
    kind, count, _, start, buffers = held.args[0][:5]
    valid, offsets, text = (None if b is None else _bytes(b) for b in buffers)
    wide = kind.args[0].startswith("large_")
    ends = np.frombuffer(offsets or b"", "<i8" if wide else "<i4")
    bits = None if valid is None else np.unpackbits(np.frombuffer(valid, "u1"), bitorder="little")
    out = np.empty(count, object)
    for k in range(start, start + count):
        missing = bits is not None and not bits[k]
        out[k - start] = None if missing else (text or b"")[ends[k] : ends[k + 1]].decode()
    return out
