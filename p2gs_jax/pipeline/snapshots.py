"""Snapshots of a fit while it runs, for `p2gs-jax view`; without a viewer none is written.

A viewer asks for a snapshot with the file `RunFolder.wanted`, which the fit removes.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable

import jax
import numpy as np

from p2gs_jax.core.atomic import atomic_folder
from p2gs_jax.gaussians.population import EMPTY_LOGIT
from p2gs_jax.photometry.appearance import exposures_apart
from p2gs_jax.pipeline.prepare import Prepared
from p2gs_jax.run.folder import RunFolder
from p2gs_jax.run.scene_file import write_scene
from p2gs_jax.run.write import write_run
from p2gs_jax.train.state import FitState

# Seconds between two looks at the file, and the largest share of a run's time for snapshots.
LOOK_S, SHARE = 1.0, 0.03


class Snapshots:
    """Writes the parameters of a fit into `RunFolder.snapshot` when they are wanted."""

    def __init__(self, folder: RunFolder, start: Prepared):
        self._folder, self._start = folder, start
        self._next, self._has_scene = 0.0, False

    def look(self, state: Callable[[], FitState], stops: bool) -> None:
        """Write a snapshot if a viewer wants one, or if the run stops unfinished (`stops`)."""
        begin, folder = time.monotonic(), self._folder
        if begin < self._next and not stops:
            return
        self._next = begin + LOOK_S
        if stops or folder.wanted.exists():
            self._write(state())
            folder.wanted.unlink(missing_ok=True)
            self._next += (time.monotonic() - begin) / SHARE

    def _write(self, state: FitState) -> None:
        start, population = self._start, state.population
        params = exposures_apart(jax.tree.map(np.asarray, state.params))
        # All slots are written: the number of rows stays, and a viewer needs no other program.
        logits = np.where(population.alive, params.gaussians.opacity_logits, EMPTY_LOGIT)
        gaussians = dataclasses.replace(params.gaussians, opacity_logits=logits)
        params = dataclasses.replace(params, gaussians=gaussians)
        owner = None if population.owner is None else np.asarray(population.owner)
        if not self._has_scene:
            write_scene(self._folder.root, start.scene)
            self._has_scene = True
        objects = {"owner": owner, "moving": start.survey.store.moving}
        with atomic_folder(self._folder.snapshot) as at:
            folder = RunFolder(self._folder.root, at)
            write_run(folder, params, start.scene, start.cfg, **objects, metering=None)
