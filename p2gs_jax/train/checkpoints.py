"""What a run's checkpoints hold, and how it continues from them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp

from p2gs_jax.config import FitConfig
from p2gs_jax.run.checkpoint import CheckpointStore
from p2gs_jax.run.decisions import KEY, Decisions
from p2gs_jax.train.host import HostState
from p2gs_jax.train.state import FitState, grow_state

# Of a run's time, what writing checkpoints may take; and by how much they may come later for it.
SHARE, LATEST = 0.01, 20.0


def pause_between(every_s: float, took_s: float) -> float:
    """Return how long a run goes on after a checkpoint, seconds.

    Args:
        every_s: as asked (`train.checkpoint_every_s`).
        took_s: what the last one took.
    """
    return max(every_s, min(took_s / SHARE, LATEST * every_s))


class RunCheckpoints:
    """State and counters of a run, and what its scene decided.

    Args:
        run_dir: the run folder.
        cfg: what the run is optimised under.
        decided: what the scene settled.
        on_message: told what the user must know.
    """

    def __init__(
        self,
        run_dir: Path,
        cfg: FitConfig,
        decided: Decisions,
        on_message: Callable[[str], None],
    ):
        self.cfg, self.on_message = cfg, on_message
        self._decided = decided
        self._store = CheckpointStore(run_dir / "checkpoints")

    def save(self, state: FitState, host: HostState) -> None:
        """Write a checkpoint."""
        meta = {
            "host": dataclasses.asdict(host),
            "gaussian_capacity": state.params.gaussians.capacity,
            KEY: self._decided.to_dict(),
        }
        self._store.save(host.step, state, meta)

    def restore(self, template: FitState) -> tuple[FitState, HostState] | None:
        """Return the newest checkpoint, or None where there is none; what is newer is removed.

        Args:
            template: a state of the same structure, of any population.

        Raises:
            UserError: none can be read, or the scene decides otherwise now.
        """
        found = self._store.restore_latest(
            lambda meta: jax.eval_shape(lambda: grow_state(template, meta["gaussian_capacity"])),
            self.on_message,
        )
        if found is None:
            return None
        self._decided.require_same(found[1].get(KEY), self._store.folder)
        state = jax.tree.map(jnp.asarray, found[0])
        host = HostState.from_dict(found[1]["host"])
        self._store.discard_after(host.step)
        self.on_message(f"Resuming after step {host.step} ({host.progress:.0%}).")
        if not _repeats(self.cfg):
            self.on_message(
                "Sums on this device come in no fixed order: the rest of the run is as good as "
                "without the interruption, but not the same bit for bit "
                "(--render.deterministic from the start fixes the order of the renderer's)."
            )
        return state, host

    def last_good(self) -> str:
        """Return in words where the newest checkpoint is."""
        latest = self._store.latest_step()
        if latest is None:
            return "no checkpoint was written yet"
        return f"the last good checkpoint is step {latest} in {self._store.folder}"


def _repeats(cfg: FitConfig) -> bool:
    """Return whether the same steps give the same bits here."""
    return jax.default_backend() == "cpu" or cfg.render.deterministic
