"""Checkpoints of any pytree through orbax: atomic, the last few kept, a broken newest survived."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import jax
import numpy as np

from p2gs_jax.errors import UserError

Tree = TypeVar("Tree")


def _named_leaves(tree) -> dict[str, Any]:
    """Return leaves under names, so that orbax need not know our record types."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {f"{i:03d}{jax.tree_util.keystr(path)}": leaf for i, (path, leaf) in enumerate(leaves)}


class CheckpointStore:
    """The checkpoints of one run.

    Args:
        folder: where they lie.
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
            logging.getLogger("absl").setLevel(logging.ERROR)
            options = ocp.CheckpointManagerOptions(
                max_to_keep=self.keep, create=True, enable_async_checkpointing=False
            )
            self._opened = ocp.CheckpointManager(self.folder.resolve(), options=options)
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
            tree: any pytree of arrays.
            meta: plain JSON values.
        """
        import orbax.checkpoint as ocp

        manager = self._manager()
        if step in manager.all_steps():
            return
        state = {k: np.asarray(v) for k, v in _named_leaves(tree).items()}
        manager.save(
            step,
            args=ocp.args.Composite(
                state=ocp.args.StandardSave(state), meta=ocp.args.JsonSave(meta)
            ),
        )
        manager.wait_until_finished()

    def read_meta(self, step: int) -> dict:
        """Return the plain values saved with a checkpoint.

        Raises:
            UserError: they cannot be read.
        """
        import orbax.checkpoint as ocp

        try:
            args = ocp.args.Composite(meta=ocp.args.JsonRestore())
            meta = self._manager().restore(step, args=args)["meta"]
        except Exception as error:
            raise self._broken(step, error) from error
        if not isinstance(meta, dict):
            raise self._broken(step, ValueError("no values in it"))
        return meta

    def restore(self, step: int, like: Tree) -> Tree:
        """Return the tree of a checkpoint.

        Args:
            step: which.
            like: arrays or shapes, in the structure that was saved.

        Raises:
            UserError: it cannot be read, or has another structure.
        """
        import orbax.checkpoint as ocp

        shapes = jax.tree.map(lambda a: np.zeros(a.shape, a.dtype), _named_leaves(like))
        try:
            args = ocp.args.Composite(state=ocp.args.StandardRestore(shapes))
            state = self._manager().restore(step, args=args)["state"]
        except Exception as error:
            raise self._broken(step, error) from error
        return jax.tree.unflatten(jax.tree.structure(like), [state[k] for k in shapes])

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
            try:
                meta = self.read_meta(step)
                return self.restore(step, like(meta)), meta
            except UserError as error:
                on_message(f"{error.message} Trying the one before it.")
                last = error
        if last is not None:
            raise last
        return None

    def discard_after(self, step: int) -> None:
        """Remove checkpoints newer than `step`, which a resumed run will write again."""
        manager = self._manager()
        for newer in [s for s in manager.all_steps() if s > step]:
            manager.delete(newer)

    def _broken(self, step: int, error: Exception) -> UserError:
        reason = str(error).splitlines()[0][:200] if str(error) else type(error).__name__
        return UserError(
            f"The checkpoint {self.folder / str(step)} cannot be read ({reason}).",
            fix="remove that folder, or start again without --resume",
        )
