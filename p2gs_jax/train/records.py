"""Files that a run writes during optimisation: `log.jsonl` and checkpoints."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from p2gs_jax.config import FitConfig
from p2gs_jax.core.atomic import append_jsonl, read_jsonl, write_text
from p2gs_jax.core.progress import LogRecord
from p2gs_jax.run.checkpoint import CheckpointStore
from p2gs_jax.run.decisions import KEY, Decisions
from p2gs_jax.train.state import FitState, HostState, shapes_of
from p2gs_jax.train.update import StepReport


def _mean(values) -> float:
    return float(np.mean([float(v) for v in values]))


class Records:
    """The log of a run and its checkpoints, and the resumption from them.

    `run_dir` holds `log.jsonl`; every record also goes to `on_log`. `store` holds state, counters
    and the options `decided` from the scene, which must be the same when a run is resumed.
    """

    def __init__(
        self,
        run_dir: Path,
        store: CheckpointStore,
        cfg: FitConfig,
        decided: Decisions,
        on_log: Callable[[LogRecord], None],
        on_message: Callable[[str], None],
    ):
        self.cfg, self.on_log, self.on_message = cfg, on_log, on_message
        self._log, self._store, self._decided = run_dir / "log.jsonl", store, decided

    def begin(
        self, template: FitState, planned: float, resume: bool
    ) -> tuple[FitState, HostState] | None:
        """Return the restored state and counters of a resumed run, else None.

        Log records after the checkpoint are dropped; without one, all are. If the run is `planned`
        for longer than before (`HostState.planned`), it continues as if this had always been so.
        """
        restored = self.restore(template) if resume else None
        if restored is None:
            self._log.unlink(missing_ok=True)
            return None
        state, host = restored
        kept = [line for line in read_jsonl(self._log) if line["step"] <= host.step]
        if planned > host.planned > 0:
            host = host.extended(planned)
            self.on_message(f"The run is planned for longer: {host.progress:.0%} of it is done.")
            last = kept[-1]["progress"] if kept else 0.0
            # A session that ended before its first checkpoint may have rewritten the log already.
            if last and abs(last - host.progress) > 1e-5:
                share = host.progress / last
                kept = [line | {"progress": round(share * line["progress"], 6)} for line in kept]
        write_text(self._log, "".join(json.dumps(line) + "\n" for line in kept))
        return state, host

    def log(
        self, reports: Sequence[StepReport], host: HostState, gaussians: int, left_s: float | None
    ) -> None:
        """Append the record of a burst of steps to the log, and pass it on.

        `reports` are the reports of its steps; `host` and `gaussians` are the counters and the
        population after it. `left_s` is the estimated time of optimisation left, seconds; None: not
        known yet.
        """
        reports = jax.device_get(list(reports))  # in one transfer: each costs a round trip
        last, train = reports[-1], self.cfg.train
        record = LogRecord(
            step=host.step,
            progress=round(host.progress, 9),
            loss=_mean(r.loss for r in reports),
            psnr=_mean(r.psnr for r in reports),
            gaussians=gaussians,
            shrink=host.shrink,
            entries=int(last.entries),
            seconds=round(host.elapsed_s, 3),
            step_seconds=round(host.step_s, 5),
            left_s=None if left_s is None else round(left_s, 1),
            terms={k: _mean(r.terms[k] for r in reports) for k in last.terms},
            steps=None if train.budget_s else train.steps,
        )
        append_jsonl(self._log, dataclasses.asdict(record))
        self.on_log(record)

    def save(self, state: FitState, host: HostState) -> None:
        """Write a checkpoint."""
        meta = {
            "host": dataclasses.asdict(host),
            "gaussian_capacity": state.params.gaussians.capacity,
            KEY: self._decided.to_dict(),
        }
        self._store.save(host.step, state, meta)

    def restore(self, template: FitState) -> tuple[FitState, HostState] | None:
        """Return the newest readable checkpoint, and delete newer ones; None: there is none.

        `template` is a state of the same structure with any number of slots. Raises UserError: no
        existing checkpoint is readable, or the scene leads to other options.
        """
        found = self._store.restore_latest(
            lambda meta: shapes_of(template, meta["gaussian_capacity"]), self.on_message
        )
        if found is None:
            return None
        state, meta = jax.tree.map(jnp.asarray, found[0]), found[1]
        self._decided.require_same(meta[KEY], self._store.folder)
        host = HostState.from_dict(meta["host"])
        self._store.discard_after(host.step)
        self.on_message(f"Resuming after step {host.step} ({host.progress:.0%}).")
        # Equal steps give equal bits only if sums have a fixed order.
        if jax.default_backend() != "cpu" and not self.cfg.render.deterministic:
            self.on_message(
                "Sums on this device have no fixed order: the rest of the run is as good as "
                "without the interruption, but not the same bit for bit "
                "(--render.deterministic from the start fixes the order in the renderer)."
            )
        return state, host

    def last_good(self) -> str:
        """Return a phrase that names the newest checkpoint."""
        latest = self._store.latest_step()
        if latest is None:
            return "the run has no checkpoint yet"
        return f"the last good checkpoint is step {latest} in {self._store.folder}"
