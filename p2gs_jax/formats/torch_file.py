"""Tensors as `torch.save` writes them, without torch: a zip with a pickle and raw storages.

The pickle says, in opcodes that `torch.load` takes with `weights_only`, how to rebuild each tensor
from a storage. https://docs.pytorch.org/docs/stable/notes/serialization.html
"""

from __future__ import annotations

import pickle
import struct
import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from p2gs_jax.core.atomic import atomic_write

FOLDER, FORMAT_VERSION = "archive", b"3\n"
Tree = Mapping[str, "Tree | np.ndarray | int"]


def write_torch(path: Path, tree: Tree) -> None:
    """Write a tree of dictionaries of float32 tensors and whole numbers.

    Args:
        path: the file.
        tree: arrays become contiguous float32 tensors on the CPU.
    """
    storages: list[Float32[np.ndarray, "..."]] = []
    body = pickle.PROTO + b"\x02" + _value(tree, storages) + pickle.STOP
    with atomic_write(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        archive.writestr(f"{FOLDER}/data.pkl", body)
        archive.writestr(f"{FOLDER}/byteorder", b"little")
        for index, array in enumerate(storages):
            archive.writestr(f"{FOLDER}/data/{index}", array.tobytes())
        archive.writestr(f"{FOLDER}/version", FORMAT_VERSION)


def _value(value: Tree | np.ndarray | int, storages: list[np.ndarray]) -> bytes:
    if isinstance(value, np.ndarray):
        return _tensor(np.ascontiguousarray(value, "<f4"), storages)
    if isinstance(value, Mapping):
        items = (_text(name) + _value(inner, storages) for name, inner in value.items())
        return pickle.EMPTY_DICT + pickle.MARK + b"".join(items) + pickle.SETITEMS
    return _number(value)


def _tensor(array: Float32[np.ndarray, "..."], storages: list[np.ndarray]) -> bytes:
    """Return a call of torch's `_rebuild_tensor_v2`; the storage is kept for its own file."""
    key = str(len(storages))
    storages.append(array)
    kept = (_text("storage"), _global("torch", "FloatStorage"), _text(key), _text("cpu"))
    storage = _tuple(*kept, _number(array.size)) + pickle.BINPERSID
    strides = [step // array.itemsize for step in array.strides]
    arguments = (
        storage,
        _number(0),
        _tuple(*map(_number, array.shape)),
        _tuple(*map(_number, strides)),
        pickle.NEWFALSE,
        _global("collections", "OrderedDict") + pickle.EMPTY_TUPLE + pickle.REDUCE,
    )
    return _global("torch._utils", "_rebuild_tensor_v2") + _tuple(*arguments) + pickle.REDUCE


def _tuple(*parts: bytes) -> bytes:
    return pickle.MARK + b"".join(parts) + pickle.TUPLE


def _global(module: str, name: str) -> bytes:
    return pickle.GLOBAL + f"{module}\n{name}\n".encode()


def _text(text: str) -> bytes:
    data = text.encode()
    return pickle.BINUNICODE + struct.pack("<I", len(data)) + data


def _number(value: int) -> bytes:
    if -(2**31) <= value < 2**31:
        return pickle.BININT + struct.pack("<i", value)
    data = int(value).to_bytes(8, "little", signed=True)
    return pickle.LONG1 + bytes([len(data)]) + data
