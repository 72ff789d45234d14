"""A scene fitted in blocks: one photometric solution, blocks as jobs, one run folder."""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import jax

from p2gs_jax.config import FitConfig
from p2gs_jax.core.atomic import no_empty_folders, write_json
from p2gs_jax.core.clock import Stopwatch
from p2gs_jax.core.memory import peak_bytes
from p2gs_jax.core.numerics import on_device
from p2gs_jax.core.progress import Reporter, Silent
from p2gs_jax.core.runtime import return_freed_memory
from p2gs_jax.errors import UserError
from p2gs_jax.evaluation.references import Reference
from p2gs_jax.formats.ply import read_ply
from p2gs_jax.jobs.blocks import plan, shared
from p2gs_jax.jobs.blocks.block import block_job
from p2gs_jax.jobs.blocks.cut import Cut, cut_scene
from p2gs_jax.jobs.blocks.seams import Seam, measure_seams, merge_cores
from p2gs_jax.jobs.engines import LOCAL, check_engine, open_engine
from p2gs_jax.jobs.job import JobState
from p2gs_jax.jobs.run import run_jobs
from p2gs_jax.photometry.calibrate import NUMBERS
from p2gs_jax.pipeline import preflight
from p2gs_jax.pipeline.finish import Account, finish
from p2gs_jax.pipeline.fit import FitResult, centred, fit
from p2gs_jax.pipeline.preflight import Paths, check_run_dir
from p2gs_jax.pipeline.survey import load
from p2gs_jax.presets import require_config
from p2gs_jax.run.decisions import read_decisions
from p2gs_jax.run.folder import RunFolder, RunLock, locked
from p2gs_jax.run.write import write_start
from p2gs_jax.scene.pixels.store import ImageStore, decoded_into
from p2gs_jax.types import Params, Scene

BLOCKS = "blocks"
# The key of the blocks in `metrics.json`.
KEY = "districts"


@dataclasses.dataclass(frozen=True)
class Request:
    """The arguments of `fit_blocks` about blocks and engines."""

    blocks: int | str
    parallel: int
    engine: str


def fit_blocks(
    scene_dir: str | Path,
    run_dir: str | Path,
    cfg: FitConfig | None = None,
    *,
    blocks: int | str = "auto",
    parallel: int = 1,
    engine: str = LOCAL,
    reference: str | Path | None = None,
    resume: bool = False,
    reporter: Reporter | None = None,
    on_look: Callable[[Sequence[JobState]], None] = lambda states: None,
    true_exposures: Mapping[str, float] | None = None,
) -> FitResult:
    """Fit a scene in blocks and write a run folder as `fit` does, with the same other arguments.

    The blocks are in the folder `blocks` of the run. `auto` is the smallest number of blocks that
    memory allows; with one block this is `fit`. `parallel` blocks are fitted at a time on the
    engine: local, dask://HOST:PORT or slurm (docs/api.md). A resumed run keeps finished blocks.
    `on_look` receives the states of all blocks, twice a second.

    Raises:
        UserError: an error that the user can correct; a failed block is named with its reason.
        Interrupted: a signal arrived; running blocks write their checkpoints first.
    """
    cfg, reporter = require_config(cfg), reporter or Silent()
    request = Request(blocks, parallel, engine)
    paths = Paths.of(scene_dir, run_dir, reference)
    if isinstance(blocks, str) and blocks != "auto":
        raise UserError(f"--blocks {blocks} is not valid.", fix="write a whole number, or auto")
    plan.check_options(cfg)
    check_engine(engine)
    weights = preflight.preflight(cfg, paths, resume=resume)
    begin = time.monotonic()
    with no_empty_folders(paths.run), locked(paths.run) as lock:
        longer = check_run_dir(paths.run, resume, cfg)
        scene = load(paths.scene, paths.run, cfg, reporter)
        plan.check_scene(scene, cfg)
        truth = preflight.check_scene(scene, cfg, paths, weights)
        cut = _cut(scene, cfg, request, paths.run / BLOCKS, reporter)
        if cut is not None:
            folders = [RunFolder(paths.run / BLOCKS / str(k)) for k in range(len(cut.blocks))]
            for block in folders if resume and RunFolder(paths.run).metrics.exists() else ():
                if longer or not block.metrics.exists():
                    preflight.require_checkpoint(block)
            for block in folders if longer else ():
                # Finished blocks continue as well, even if this process ends before they start.
                block.metrics.unlink(missing_ok=True)
            whole = _Blocks(paths, cfg, request, cut, lock, reporter, on_look)
            with decoded_into(whole.folder.pixels):
                return whole.fit(scene, truth, weights, begin, true_exposures)
    # With one block the scene is fitted as usual.
    return fit(
        paths.scene,
        paths.run,
        cfg,
        reference=paths.reference,
        resume=resume,
        reporter=reporter,
        true_exposures=true_exposures,
        spent_s=time.monotonic() - begin,
    )


def _cut(
    scene: Scene, cfg: FitConfig, request: Request, folder: Path, reporter: Reporter
) -> Cut | None:
    """Return the cut of the scene, the earlier one if there is one; None: one block is enough."""
    cut = plan.read_plan(folder, str(request.blocks))
    if cut is None:
        count = request.blocks
        if isinstance(count, str):
            count = plan.fewest_blocks(scene, cfg, request.parallel)
        if count == 1:
            reporter.message("One block: the scene is fitted as a whole.")
            return None
        cut = cut_scene(scene, count)
    # Other machines have other memory.
    if request.engine == LOCAL:
        plan.require_room(scene, cfg, cut, request.parallel)
    sizes = [len(block.views) for block in cut.blocks]
    reporter.message(
        f"{len(sizes)} blocks with {min(sizes)} to {max(sizes)} of {len(scene.train_indices)} "
        f"training photographs; they extend {cut.margin:.3g} scene units beyond their cores."
    )
    return cut


@dataclasses.dataclass
class _Blocks:
    """A fit of a scene in blocks, in a locked run folder."""

    paths: Paths
    cfg: FitConfig
    request: Request
    cut: Cut
    lock: RunLock
    reporter: Reporter
    on_look: Callable[[Sequence[JobState]], None]

    def __post_init__(self):
        self.folder, self.blocks = RunFolder(self.paths.run), self.paths.run / BLOCKS
        self.clock = Stopwatch()

    def fit(
        self, scene: Scene, truth: Reference | None, weights, begin: float, true_exposures
    ) -> FitResult:
        """Solve the photometry, fit and merge all blocks, evaluate; the run began at `begin`."""
        with self.clock("photometry"):
            solved = self._solve(scene)
        with self.clock("blocks"):
            self._fit_blocks()
        self.reporter.stage("Merging blocks")
        store = ImageStore(solved.scene.views, self.cfg.data, folder=self.folder.pixels)
        decisions = solved.exposures.decisions
        cfg = decisions.resolve(self.cfg)
        fitted = [
            read_ply(RunFolder(self.blocks / str(k)).radiance) for k in range(len(self.cut.blocks))
        ]
        with self.clock("seams"):
            seams = measure_seams(solved.scene, store, self.cut, fitted, cfg.render)
        gaussians, counts = merge_cores(self.cut, fitted)
        fitted.clear()
        photometry = jax.tree.map(on_device, solved.exposures.photometry)
        params = centred(Params(gaussians, photometry), cfg)
        self._report(seams)
        self.lock.require()
        account = self._account(scene, solved, gaussians.capacity, time.monotonic() - begin)
        metrics = finish(
            params,
            solved.scene,
            store,
            cfg,
            self.folder,
            account,
            self.reporter,
            truth=truth,
            lpips_weights=weights,
            true_exposures=true_exposures,
            check_lock=self.lock.require,
        )
        metrics[KEY] = self._summary(seams, counts)
        write_json(self.folder.metrics, metrics)
        return FitResult(
            params, solved.scene, metrics, self.paths.run, solved.exposures.selection, decisions
        )

    def _account(
        self, scene: Scene, solved: shared.Shared, gaussians: int, seconds: float
    ) -> Account:
        blocks = [self._of_block(k) for k in range(len(self.cut.blocks))]
        optimisation = sum(found["seconds"]["optimisation"] for found in blocks)
        return Account(
            counts={
                "gaussians": gaussians,
                "seed_points": len(scene.points),
                "train_views": len(scene.train_indices),
                "test_views": len(scene.test_indices),
                "steps": sum(found["counts"]["steps"] for found in blocks),
                "blocks": len(blocks),
            },
            seconds={
                **self.clock.seconds,
                "total_until_evaluation": seconds,
                "optimisation": optimisation,  # the sum over all blocks
            },
            selection=solved.exposures.selection,
            notes=[*solved.scene.notes, *solved.exposures.notes],
        )

    def _solve(self, scene: Scene) -> shared.Shared:
        store = ImageStore(scene.views, self.cfg.data, folder=self.folder.pixels)
        kept = read_decisions(self.blocks / shared.DECISIONS)
        solved = shared.solve_shared(scene, store, self.cfg, self.reporter, kept)
        store.close()
        return_freed_memory()
        for note in (*scene.notes, *solved.exposures.notes):
            if not note.startswith(NUMBERS):
                self.reporter.message(note)
        self.lock.require()
        found, paths = solved.exposures, self.paths
        start = self.folder, paths.scene, paths.reference, self.cfg, found.decisions, scene.views
        write_start(*start)
        if (self.blocks / shared.ARRAYS).exists():
            # The exposures of finished blocks must stay exactly the same.
            before = shared.read_shared(self.blocks, scene, self.cfg)
            new = {"selection": found.selection, "notes": found.notes}
            exposures = dataclasses.replace(before.exposures, **new)
            return dataclasses.replace(before, exposures=exposures)
        plan.write_plan(self.blocks, self.cut, str(self.request.blocks))
        shared.write_shared(self.blocks, solved)
        return solved

    def _fit_blocks(self) -> None:
        left = [
            block_job(self.paths.scene, self.paths.run, self.blocks, self.cut, k, self.cfg)
            for k in range(len(self.cut.blocks))
            if not RunFolder(self.blocks / str(k)).metrics.exists()
        ]
        if not left:
            return
        jobs = self.blocks / "jobs"
        with open_engine(self.request.engine, self.request.parallel, jobs) as workers:
            states = run_jobs(left, workers, jobs, on_end=self._ended, on_look=self.on_look)
        failed = [f"{s.name}: {s.reason}" for s in states if s.status != "done"]
        if failed:
            raise UserError(
                f"{len(failed)} of {len(self.cut.blocks)} blocks failed. " + "; ".join(failed),
                fix="correct the cause and add --resume: finished blocks are kept",
            )

    def _ended(self, number: int, state: JobState) -> None:
        result = "fitted" if state.status == "done" else state.status
        self.reporter.message(f"{state.name}: {result} after {state.seconds:.0f} s.")

    def _of_block(self, number: int) -> dict:
        return json.loads(RunFolder(self.blocks / str(number)).metrics.read_text(encoding="utf-8"))

    def _report(self, seams: Sequence[Seam]) -> None:
        compared = [s for s in seams if s.step_stops is not None]
        if compared:
            worst = max(compared, key=lambda s: abs(s.step_stops or 0.0))
            self.reporter.message(
                f"The largest step of radiance between blocks is {worst.step_stops:+.4f} stops "
                f"(blocks {worst.blocks[0]} and {worst.blocks[1]}). The median difference is "
                f"{worst.spread_stops:.3f} stops, and {worst.spread_depth:.1%} of the depth."
            )

    def _summary(self, seams: Sequence[Seam], counts: Sequence[int]) -> dict:
        """Return the part of `metrics.json` on the blocks."""
        rows = []
        for number, (block, kept) in enumerate(zip(self.cut.blocks, counts, strict=True)):
            found = self._of_block(number)
            rows.append(
                {
                    "views": len(block.views),
                    "gaussians_in_core": kept,
                    **found["counts"],
                    "seconds": found["seconds"]["total"],
                    "peak_bytes": found["peak_bytes"],
                }
            )
        return {
            "blocks": rows,
            "seams": [dataclasses.asdict(seam) for seam in seams],
            "margin": self.cut.margin,
            "peak_bytes_merging": peak_bytes(),
        }
