"""Checkpoints of any pytree through orbax: atomic, the last few kept, a broken newest survived.

All leaves travel as one buffer of bytes, uncompressed, beside a JSON list of their names, types,
shapes and checksums. One array is read and written faster than a hundred, leaves of size zero
need no care, a broken file is one error instead of a page of asyncio's, and the checksums find
what orbax lets pass: flipped bits.
"""

from __future__ import annotations

import json
import logging
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import jax
import numpy as np

from p2gs_jax.core.disk import naming
from p2gs_jax.errors import UserError

Tree = TypeVar("Tree")


def _named_leaves(tree) -> dict[str, Any]:
    """Return leaves under names, so that a checkpoint of another structure is recognised."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {f"{i:03d}{jax.tree_util.keystr(path)}": leaf for i, (path, leaf) in enumerate(leaves)}


def _pack(tree) -> tuple[np.ndarray, dict[str, list]]:
    """Return the bytes of all leaves, and [type, shape, checksum] of each by name."""
    arrays = {k: np.asarray(v) for k, v in _named_leaves(tree).items()}
    parts = [np.ascontiguousarray(a).reshape(-1).view(np.uint8) for a in arrays.values()]
    # One byte more, because orbax refuses to write nothing.
    data = np.concatenate([*parts, np.zeros(1, np.uint8)])
    table = {
        name: [array.dtype.name, list(array.shape), zlib.crc32(part.data)]
        for (name, array), part in zip(arrays.items(), parts, strict=True)
    }
    return data, table


def saved_steps(folder: Path) -> list[int]:
    """Return the steps of complete checkpoints, by the names in their folder; rising."""
    if not folder.is_dir():
        return []
    return sorted(int(path.name) for path in folder.iterdir() if path.name.isdecimal())


def _unpack(data: np.ndarray, table: dict[str, list]) -> list[np.ndarray]:
    """Return the leaves; each owns its memory.

    Raises:
        ValueError: a checksum differs or bytes are missing.
    """
    leaves, start = [], 0
    for name, (kind, shape, checksum) in table.items():
        dtype = np.dtype(kind)
        part = data[start : start + dtype.itemsize * int(np.prod(shape))]
        start += part.size
        if zlib.crc32(part.data) != checksum:
            raise ValueError(f"the checksum of {name} is wrong")
        leaves.append(part.copy().view(dtype).reshape(shape))
    return leaves


def _plain_scalar(value):
    """Turn a numpy or jax value into a plain one, for `json.dumps`."""
    if hasattr(value, "tolist"):
        return np.asarray(value).tolist()
    raise TypeError(f"{type(value).__name__} in a checkpoint's values is not JSON")


class CheckpointStore:
    """The checkpoints of one run.

    Args:
        folder: where they lie. One run writes to it at a time: what an interrupted save left
            behind is removed in the background when the store opens, at the latest by the next
            save.
        keep: how many.
    """

    def __init__(self, folder: Path, keep: int = 2):
        self.folder = Path(folder)
        self.keep = keep
        self._opened = None

    def _manager(self):
        # Imported late: orbax costs most of a second, which --help should not.
        import orbax.checkpoint as ocp

        if self._opened is None:
            # What fails is raised to us as well; it logs pages of it.
            logging.getLogger("absl").setLevel(logging.CRITICAL)
            options = ocp.CheckpointManagerOptions(
                max_to_keep=self.keep,
                create=True,
                cleanup_tmp_directories=True,
                enable_async_checkpointing=False,
            )
            handler = ocp.PyTreeCheckpointHandler(use_ocdbt=False, use_compression=False)
            self._opened = ocp.CheckpointManager(
                self.folder.resolve(),
                options=options,
                item_handlers={"leaves": handler, "meta": ocp.JsonCheckpointHandler()},
            )
        return self._opened

    def latest_step(self) -> int | None:
        """Return the newest complete checkpoint, or None."""
        if not self.folder.is_dir():
            return None
        return self._manager().latest_step()

    def save(self, step: int, tree: Any, meta: dict) -> None:
        """Write a checkpoint; an interruption leaves the previous ones as they were.

        Args:
            step: its number; one that exists already is left alone.
            tree: any pytree of arrays; None and static fields come from `like` on restoring.
            meta: JSON values; scalars and arrays of numpy and jax become plain ones.

        Raises:
            TypeError: `meta` holds something else.
            OSError: it cannot be written, for example because the disk is full.
        """
        import orbax.checkpoint as ocp

        manager = self._manager()
        if step in manager.all_steps():
            return
        data, table = _pack(tree)
        saved = json.loads(json.dumps({"meta": meta, "leaves": table}, default=_plain_scalar))
        with naming(self.folder, size=data.nbytes):
            manager.save(
                step,
                args=ocp.args.Composite(
                    leaves=ocp.args.PyTreeSave({"data": data}),
                    meta=ocp.args.JsonSave(saved),
                ),
            )
            manager.wait_until_finished()

    def read_meta(self, step: int) -> dict:
        """Return the plain values saved with a checkpoint.

        Raises:
            UserError: they cannot be read.
        """
        return self._read_json(step)["meta"]

    def latest_meta(self) -> dict | None:
        """Return the plain values of the newest checkpoint whose values can be read, or None."""
        if not self.folder.is_dir():
            return None
        for step in sorted(self._manager().all_steps(), reverse=True):
            try:
                return self.read_meta(step)
            except UserError:
                continue  # `restore_latest` says so
        return None

    def restore(self, step: int, like: Tree) -> tuple[Tree, dict]:
        """Return the tree of a checkpoint, bit for bit in numpy arrays, and its plain values.

        Args:
            step: which.
            like: arrays or shapes, in the structure that was saved.

        Raises:
            UserError: it cannot be read, or holds other leaves, shapes or types than `like`.
        """
        import orbax.checkpoint as ocp

        saved = self._read_json(step)
        table = saved["leaves"]
        self._check_structure(step, table, like)
        try:
            as_numpy = ocp.RestoreArgs(restore_type=np.ndarray)
            args = ocp.args.PyTreeRestore(item={"data": 0}, restore_args={"data": as_numpy})
            found = self._manager().restore(step, args=ocp.args.Composite(leaves=args))
            leaves = _unpack(found["leaves"]["data"], table)
        except Exception as error:
            raise self._broken(step, error) from error
        return jax.tree.unflatten(jax.tree.structure(like), leaves), saved["meta"]

    def restore_latest(
        self,
        like: Callable[[dict], Tree],
        on_message: Callable[[str], None] = lambda text: None,
    ) -> tuple[Tree, dict] | None:
        """Return the newest readable checkpoint and its values, or None where there is none.

        Args:
            like: from the saved values to arrays or shapes of the structure that was saved.
            on_message: told about checkpoints that could not be read.

        Raises:
            UserError: there are checkpoints and none can be read.
        """
        if not self.folder.is_dir():
            return None
        steps = sorted(self._manager().all_steps(), reverse=True)
        last: UserError | None = None
        for step in steps:
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
        manager = self._manager()
        for newer in [s for s in manager.all_steps() if s > step]:
            manager.delete(newer)

    def _read_json(self, step: int) -> dict:
        import orbax.checkpoint as ocp

        try:
            args = ocp.args.Composite(meta=ocp.args.JsonRestore())
            saved = self._manager().restore(step, args=args)["meta"]
            if not isinstance(saved, dict) or not {"meta", "leaves"} <= set(saved):
                raise ValueError("it is none of this version")
        except Exception as error:
            raise self._broken(step, error) from error
        return saved

    def _check_structure(self, step: int, table: dict[str, list], like) -> None:
        named = _named_leaves(like)
        wanted = {k: (np.dtype(v.dtype).name, tuple(v.shape)) for k, v in named.items()}
        held = {k: (kind, tuple(shape)) for k, (kind, shape, _) in table.items()}
        differing = [k for k in {**wanted, **held} if wanted.get(k) != held.get(k)]
        if not differing:
            return
        name = differing[0]
        found, expected = held.get(name, "absent"), wanted.get(name, "absent")
        raise UserError(
            f"The checkpoint {self.folder / str(step)} belongs to another version or "
            f"configuration: {name} is {found}, not {expected}.",
            fix="resume with the version and the configuration of the run, or start again without "
            "--resume",
        )

    def _broken(self, step: int, error: Exception) -> UserError:
        reason = str(error).splitlines()[0][:200] if str(error) else type(error).__name__
        return UserError(
            f"The checkpoint {self.folder / str(step)} cannot be read ({reason}).",
            fix="remove that folder, or start again without --resume",
        )
