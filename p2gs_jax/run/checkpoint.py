"""Checkpoints of any pytree: complete or absent; a broken newest one is skipped.

A checkpoint is a folder named by its step, with one `.npz`: the bytes of every leaf, a table of
names, types and shapes, and plain values. The checksums of the archive detect flipped bits.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import jax
import numpy as np

from p2gs_jax.core.atomic import BROKEN_ARRAYS, atomic_folder, naming, remove_begun
from p2gs_jax.errors import UserError

Tree = TypeVar("Tree")
FILE, TABLE = "state.npz", "table"


def saved_steps(folder: Path) -> list[int]:
    """Return the steps of complete checkpoints, by the names in their folder, ascending."""
    if not folder.is_dir():
        return []
    return sorted(int(path.name) for path in folder.iterdir() if path.name.isdecimal())


class CheckpointStore:
    """The last few checkpoints of one run; one run writes to their folder at a time."""

    def __init__(self, folder: Path, keep: int = 2):
        self.folder, self.keep = Path(folder), keep

    def latest_step(self) -> int | None:
        """Return the step of the newest complete checkpoint, or None."""
        return max(saved_steps(self.folder), default=None)

    def save(self, step: int, tree: Any, meta: dict) -> None:
        """Write a checkpoint; an interruption does not change the previous ones.

        An existing checkpoint is not written again. The tree is any pytree of arrays: None and
        static fields come from `like` in `restore`. In `meta`, arrays become plain values. Raises
        TypeError: `meta` holds something else. Raises OSError: the checkpoint cannot be written,
        for example because the disk is full.
        """
        if step in saved_steps(self.folder):
            return
        leaves = {k: np.asarray(v) for k, v in _named_leaves(tree).items()}
        table = {name: [leaf.dtype.name, list(leaf.shape)] for name, leaf in leaves.items()}
        values = json.dumps({"meta": meta, "leaves": table}, default=_plain_scalar)
        parts = [np.ascontiguousarray(leaf).reshape(-1).view(np.uint8) for leaf in leaves.values()]
        remove_begun(self.folder, spare=".lock")
        with (
            naming(self.folder, size=sum(part.nbytes for part in parts)),
            atomic_folder(self.folder / str(step)) as folder,
        ):
            arrays = {f"arr_{i}": part for i, part in enumerate(parts)}
            arrays[TABLE] = np.array(values)
            np.savez(folder / FILE, allow_pickle=False, **arrays)
        for older in saved_steps(self.folder)[: -self.keep]:
            shutil.rmtree(self.folder / str(older))

    def read_meta(self, step: int) -> dict:
        """Return the plain values saved with a checkpoint; UserError: it cannot be read."""
        return self._read(step)[0]

    def latest_meta(self) -> dict | None:
        """Return the plain values of the newest checkpoint whose values can be read, or None."""
        for step in reversed(saved_steps(self.folder)):
            try:
                return self.read_meta(step)
            except UserError:
                continue  # `restore_latest` reports the error
        return None

    def restore(self, step: int, like: Tree) -> tuple[Tree, dict]:
        """Return the tree of a checkpoint, bit for bit in numpy arrays, and its plain values.

        `like` has arrays or shapes, in the structure that was saved. UserError: the checkpoint
        cannot be read, or its structure differs from `like`.
        """
        meta, leaves = self._read(step, like)
        return jax.tree.unflatten(jax.tree.structure(like), leaves), meta

    def restore_latest(
        self, like: Callable[[dict], Tree], on_message: Callable[[str], None] = lambda text: None
    ) -> tuple[Tree, dict] | None:
        """Return the newest readable checkpoint and its values, or None if there is none.

        `like` is called with the saved values, and returns the `like` of `restore`; `on_message`
        receives messages on checkpoints that cannot be read. UserError: none can be read.
        """
        last: UserError | None = None
        for step in reversed(saved_steps(self.folder)):
            if last is not None:
                on_message(f"{last.message} Trying the one before it.")
            try:
                return self.restore(step, like(self.read_meta(step)))
            except UserError as error:
                last = error
        if last is not None:
            raise last
        return None

    def discard_after(self, step: int) -> None:
        """Remove checkpoints newer than `step`, which a resumed run will write again."""
        for newer in saved_steps(self.folder):
            if newer > step:
                shutil.rmtree(self.folder / str(newer))

    def _read(self, step: int, like: Any = None) -> tuple[dict, list[np.ndarray]]:
        """Return the plain values, and the leaves if `like` gives their structure."""
        try:
            # NumPy does not close a broken file.
            path = self.folder / str(step) / FILE
            with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
                values = json.loads(str(file[TABLE]))
                meta, table = values["meta"], values["leaves"]
                if like is not None:
                    self._check_structure(step, table, like)
                leaves = [] if like is None else [file[f"arr_{i}"] for i in range(len(table))]
            shaped = zip(leaves, table.values(), strict=like is not None)
            return meta, [a.view(np.dtype(kind)).reshape(shape) for a, (kind, shape) in shaped]
        except UserError:
            raise
        except BROKEN_ARRAYS as error:
            reason = str(error).splitlines()[0][:200] if str(error) else type(error).__name__
            why = f"The checkpoint {self.folder / str(step)} cannot be read ({reason})."
            fix = "put a copy in its place, or start again in another folder with --out"
            raise UserError(why, fix=fix) from error

    def _check_structure(self, step: int, table: dict[str, list], like) -> None:
        named = _named_leaves(like)
        wanted = {k: (np.dtype(v.dtype).name, tuple(v.shape)) for k, v in named.items()}
        held = {k: (kind, tuple(shape)) for k, (kind, shape) in table.items()}
        differing = [k for k in {**wanted, **held} if wanted.get(k) != held.get(k)]
        if differing:
            name = differing[0]
            found, expected = held.get(name, "absent"), wanted.get(name, "absent")
            why = f"The checkpoint {self.folder / str(step)} belongs to another version or "
            why += f"configuration: {name} is {found}, not {expected}."
            fix = "resume with the version and the configuration of the run, or start again "
            fix += "in another folder with --out"
            raise UserError(why, fix=fix)


def _named_leaves(tree) -> dict[str, Any]:
    """Return leaves by name; names differ between structures."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {f"{i:03d}{jax.tree_util.keystr(path)}": leaf for i, (path, leaf) in enumerate(leaves)}


def _plain_scalar(value):
    """Return a numpy or jax value as a plain one, for `json.dumps`."""
    if hasattr(value, "tolist"):
        return np.asarray(value).tolist()
    raise TypeError(f"{type(value).__name__} in a checkpoint's values is not JSON")
