"""`fit` and `calibrate`: from photographs to a run folder, or to exposures alone."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import tyro

from p2gs_jax.cli.shared import DURATIONS, SHORT, check
from p2gs_jax.config import FitConfig, PresetName

Preset = Annotated[PresetName, tyro.conf.arg(metavar="NAME")]
Config = Annotated[FitConfig, tyro.conf.arg(name="")]
Folder = Annotated[Path, tyro.conf.arg(metavar="DIR")]


@dataclass(frozen=True)
class Fit:
    """Fit linear HDR radiance, exposures and gammas to photographs.

    Writes a run folder; open its summary.png first. An interrupted run goes on with --resume.

        p2gs-jax fit castle --out runs/castle --max-width 960 --budget 20m
        p2gs-jax fit castle --out runs/castle --resume
        p2gs-jax fit castle --out runs/paper --preset paper --steps 7000
    """

    SHORT_NAMES: ClassVar = tuple(SHORT)
    scene: Annotated[Path, tyro.conf.Positional]
    """COLMAP model, transforms.json, Blender's or LLFF's folder, a drive of a data set (PandaSet,
    nuScenes, ...), a folder of photographs, or a video (docs/scenes.md)."""
    out: Folder
    """Run folder to create."""
    config: Config
    resume: bool = False
    """Continue an interrupted run; give the options it was started with. A larger --steps or
    --budget also continues one that is finished."""
    preset: Preset = "robust"
    """Initial values: robust; the method as printed, paper or paper_appendix; baselines 3dgs
    (3dgs_published: as printed, 30000 steps), 3dgs_gain, 3dgs_affine, 3dgs_bilateral, 3dgs_curve,
    luminance_gs or ppisp; or ppisp_solved."""
    reference: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Photographs of the same views under one common exposure, for evaluation."""
    blocks: int | Literal["auto"] | None = None
    """Cut the scene into N blocks that are fitted apart and merged; auto: into as few as memory
    allows (docs/scaling.md). Default: one fit."""
    jobs: int = 1
    """Blocks at a time on this machine."""
    engine: Annotated[str, tyro.conf.arg(metavar="NAME")] = "local"
    """Where blocks are fitted: local, dask://HOST:PORT, or slurm:OPTION=VALUE,...
    (docs/api.md)."""
    threads: int | None = None
    """Cores of the CPU that a view is divided over. Default: 4 where there are as many; XLA makes
    as good a use of fewer. Results repeat bit for bit with the same number."""
    devices: int | Literal["all"] = 1
    """Devices of a step, each with its own views (--train.batch; default then: one view each)."""

    def execute(self) -> int:
        """Fit the scene; print the place and the scores of the results."""
        import time
        from functools import partial

        from p2gs_jax.cli.tables import print_metrics
        from p2gs_jax.core.progress import TerminalReporter
        from p2gs_jax.core.runtime import use_cores
        from p2gs_jax.pipeline.fit import fit
        from p2gs_jax.train.data_parallel import with_a_view_each

        self._check()
        if self.blocks is None:
            use_cores(self.threads)
        with TerminalReporter() as reporter:
            cfg = checked(self.config)
            common = {"reference": self.reference, "resume": self.resume, "reporter": reporter}
            if self.blocks is None:
                # Starting the interpreter and loading libraries is processor time throughout.
                common |= {"spent_s": time.process_time(), "devices": self.devices}
                cfg = with_a_view_each(cfg, self.devices)
                result = fit(self.scene, self.out, cfg, **common)
            else:
                from p2gs_jax.jobs.blocks.fit import fit_blocks
                from p2gs_jax.jobs.table import show

                common |= {"blocks": self.blocks, "parallel": self.jobs, "engine": self.engine}
                show_jobs = partial(show, reporter)
                result = fit_blocks(self.scene, self.out, cfg, **common, on_look=show_jobs)
        print_metrics(result.metrics, self.out)
        return 0

    def _check(self) -> None:
        count, whole = self.blocks, "write a whole number from 1 on, or"
        why = "--jobs and --engine say nothing without --blocks"
        fix = "add --blocks auto, or a number"
        check(count is not None or (self.jobs == 1 and self.engine == "local"), why, fix=fix)
        right = not isinstance(count, int) or count >= 1
        check(right, f"--blocks {count} is not a number of blocks", fix=f"{whole} auto")
        check(self.jobs >= 1, "--jobs must be at least 1")
        right = self.threads is None or self.threads >= 1
        check(right, f"--threads {self.threads} is not a number of cores", fix="give 1 or more")
        why = "--blocks fits every block on one device, and on a CPU on one core"
        fix = "leave out --devices and --threads; blocks have --jobs and --engine"
        alone = self.devices == 1 and self.threads is None
        check(count is None or alone, why, fix=fix)
        right = not isinstance(self.devices, int) or self.devices >= 1
        check(right, f"--devices {self.devices} is not a number of devices", fix=f"{whole} all")


@dataclass(frozen=True)
class Calibrate:
    """Solve exposures, gammas and tone curve alone, in seconds.

    From the colours of shared points, without splatting, and with standard errors. Prints a table
    and writes photometry.json; open calibration.png first.

        p2gs-jax calibrate castle --out photometry
        p2gs-jax calibrate castle --out photometry --known-exposures exif
        p2gs-jax calibrate stack --out photometry --static
    """

    SHORT_NAMES: ClassVar = (
        *("max_width", "known_exposures", "known_deviation_ev", "images", "drive", "cameras"),
        *("frames", "every", "max_frames", "camera_by"),
    )
    # What is read of the configuration; the rest is no option.
    FIELDS: ClassVar = (
        *("data", "loss.black", "loss.saturation", "train.seed", "photometry.known"),
        *("photometry.known_deviation_ev", "photometry.select", "photometry.model"),
        *("photometry.curve", "photometry.spline", "photometry.white_balance"),
        *("photometry.vignetting", "photometry.responses", "photometry.pivot"),
    )
    scene: Annotated[Path, tyro.conf.Positional]
    """COLMAP model, transforms.json, a folder of photographs, a video (docs/scenes.md), or a
    finished run (correspondences then go through its rendered depth)."""
    out: Folder
    """Folder for photometry.json and calibration.png."""
    config: Config
    compare_with: Annotated[str | None, tyro.conf.arg(metavar="FILE|exif")] = None
    """Stated exposures to compare with; default: EXIF."""
    static: bool = False
    """The folder holds photographs from one fixed viewpoint at several exposures."""
    preset: Preset = "robust"
    """Initial values; see `fit`."""

    def execute(self) -> int:
        """Solve the photometry alone; print it as a table."""
        from p2gs_jax.cli.tables import print_calibration, print_stack
        from p2gs_jax.core.progress import TerminalReporter
        from p2gs_jax.pipeline.calibrate import calibrate, calibrate_run, calibrate_stack

        scene, out, cfg = self.scene, self.out, self.checked()
        with TerminalReporter() as reporter:
            how = {"compare_with": self.compare_with, "reporter": reporter}
            if self.static:
                show, found = print_stack, calibrate_stack(scene, out, cfg, **how)
            else:
                show, solve = print_calibration, calibrate_run if self.is_run else calibrate
                found = solve(scene, out, cfg, **how)
        show(found, out)
        return 0

    @property
    def is_run(self) -> bool:
        """Whether the scene is a finished run."""
        return all((self.scene / name).is_file() for name in ("config.json", "radiance.ply"))

    def checked(self) -> FitConfig:
        """Return the configuration; raise a UserError where a value makes no sense."""
        scene, is_run, data, usual = self.scene, self.is_run, self.config.data, FitConfig().data
        own_size = data == usual
        why = "--data.test-every and --data.split say nothing here"
        fix = "leave them out: every photograph is calibrated"
        check((data.test_every, data.split) == (usual.test_every, usual.split), why, fix=fix)
        cfg, leave_out = checked(self.config), "leave out --max-width, --images and --data options"
        why = "--static reads every photograph of the folder at its own size"
        check(own_size or not self.static, why, fix=leave_out)
        why = f"{scene} is a finished run: it keeps its own image size and folder"
        check(own_size or not is_run, why, fix=leave_out)
        return cfg


def checked(cfg: FitConfig) -> FitConfig:
    """Return the configuration; raise a UserError where a value makes no sense."""
    data, train, known, behind = cfg.data, cfg.train, cfg.photometry, cfg.render.background
    most = cfg.densify.max_gaussians
    check(data.max_width is None or data.max_width >= 16, "--max-width must be at least 16")
    check(data.every is None or data.every >= 1, "--every must be at least 1")
    check(data.max_frames >= 2, "--max-frames must be at least 2")
    check(data.test_every >= 0, "--test-every must be 0 or more")
    check(train.budget_s is None or train.budget_s > 0, "--budget leaves no time", fix=DURATIONS)
    check(train.steps >= 1, "--steps must be at least 1")
    check(train.batch >= 1, "--train.batch must be at least 1")
    check(not isinstance(most, int) or most >= 1, "--gaussians must be at least 1")
    why = "--render.background must be linear radiance, three numbers that are not negative"
    check(all(math.isfinite(x) and x >= 0 for x in behind or ()), why)
    check(known.known_deviation_ev >= 0, "--known-deviation-ev must be 0 or more")
    why = "--known-deviation-ev says nothing without --known-exposures"
    fix = "add --known-exposures FILE, or exif"
    check(known.known_deviation_ev == 0 or known.known is not None, why, fix=fix)
    return cfg
