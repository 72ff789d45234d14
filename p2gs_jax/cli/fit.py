"""`inspect`, `fit` and `calibrate`: from photographs to a run folder, or to exposures alone."""

from __future__ import annotations

import contextlib
import datetime
import glob
import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import tyro

from p2gs_jax.cli.shared import check, require_viewer
from p2gs_jax.config import DataConfig, FitConfig, PresetName
from p2gs_jax.core.text import count_of
from p2gs_jax.options import SHORT
from p2gs_jax.presets import flat, preset, to_dict

if TYPE_CHECKING:
    from p2gs_jax.scene.survey import Survey

Preset = Annotated[PresetName, tyro.conf.arg(metavar="NAME")]
Config = Annotated[FitConfig, tyro.conf.arg(name="")]


@dataclass(frozen=True)
class Cluster:
    """A large scene is cut into blocks, which one machine or a cluster (Dask, Slurm) fits."""

    blocks: int | Literal["auto"] | None = None
    """Number of blocks that are fitted separately and merged; auto: as few as memory allows."""
    jobs: int = 1
    """Number of blocks that this machine fits at the same time."""
    engine: Annotated[str, tyro.conf.arg(metavar="NAME")] = "local"
    """Where blocks are fitted: local, dask://HOST:PORT, or slurm:OPTION=VALUE,... (docs/api.md)."""
    devices: int | Literal["all"] = 1
    """Number of devices that share a step (--train.batch) of a fit without blocks."""


@dataclass(frozen=True, kw_only=True)
class Fit:
    """Fit linear HDR radiance, exposures and tone curves to photographs.

    The command writes a run folder; open its summary.png first. --resume continues an interrupted
    run.

        p2gs-jax fit castle --max-width 960 --budget 20m
        p2gs-jax fit castle --resume
        p2gs-jax fit castle --out runs/paper --preset paper --steps 7000
    """

    SHORT_NAMES: ClassVar = tuple(SHORT)
    scene: Annotated[Path, tyro.conf.Positional]
    """COLMAP model, transforms.json, Blender's or LLFF's folder, a drive of a data set (PandaSet,
    nuScenes, ...), a folder of photographs, or a video (docs/scenes.md)."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Run folder (default: runs/SCENE-DATE; with --resume the newest of these)."""
    resume: bool = False
    """Continue an interrupted run; larger --steps or --budget also continue a finished one."""
    config: Config
    preset: Preset = "robust"
    """Preset of options: robust; paper or paper_appendix (as printed); or one of the baselines
    3dgs, 3dgs_published, 3dgs_gain, 3dgs_affine, 3dgs_bilateral, 3dgs_curve, luminance_gs, ppisp,
    ppisp_solved."""
    reference: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Photographs of the same views under one common exposure, for evaluation."""
    threads: int | None = None
    """CPU cores per view (default: 4; 1 if there are fewer); equal numbers give equal results."""
    verbose: bool = False
    """Print all scores, and the seconds of each part of the fit."""
    view: bool = False
    """Show the scene in the browser while it is fitted (needs the viewer's libraries)."""
    port: int = 8080
    """Port of --view; 0: any free port."""
    cluster: Annotated[Cluster, tyro.conf.OmitArgPrefixes] = Cluster()

    def execute(self) -> int:
        """Fit the scene; print the scores and the place of the results."""
        import time
        from functools import partial

        from p2gs_jax.cli.tables import print_headline, print_metrics
        from p2gs_jax.cli.watched import WatchedReporter
        from p2gs_jax.core.progress import TerminalReporter
        from p2gs_jax.core.runtime import use_cores
        from p2gs_jax.pipeline.fit import fit
        from p2gs_jax.run.folder import RunFolder
        from p2gs_jax.train.data_parallel import with_a_view_each

        self._check()
        cfg, out, cluster = self.config, self.run_folder(), self.cluster
        if cluster.blocks is None:
            use_cores(self.threads)
        shown = WatchedReporter(out, self.port) if self.view else TerminalReporter()
        with _naming_checkpoint(out), shown as reporter:
            if self.resume and not RunFolder(out).config.exists():
                reporter.message(f"{out} holds no run to continue: a new one begins.")
            common = {"reference": self.reference, "resume": self.resume, "reporter": reporter}
            if cluster.blocks is None:
                # The budget includes the start of Python, whose duration is about its CPU time.
                common |= {"spent_s": time.process_time(), "devices": cluster.devices}
                cfg = with_a_view_each(cfg, cluster.devices)
                result = fit(self.scene, out, cfg, **common)
            else:
                from p2gs_jax.jobs.blocks.fit import fit_blocks
                from p2gs_jax.jobs.table import show

                common |= {"blocks": cluster.blocks, "parallel": cluster.jobs}
                common |= {"engine": cluster.engine, "on_look": partial(show, reporter)}
                result = fit_blocks(self.scene, out, cfg, **common)
        if self.verbose:
            print_metrics(result.metrics)
        print_headline(result.metrics, out)
        return 0

    def run_folder(self) -> Path:
        """Return --out; else a new folder with today's date, or with --resume the newest run."""
        if self.out is not None:
            return self.out
        scene, runs = self.scene.resolve(), Path("runs")
        name = scene.stem if scene.is_file() else scene.name or "scene"
        if self.resume:
            dated = runs.glob(f"{glob.escape(name)}-20[0-9][0-9]-[01][0-9]-[0-3][0-9]*")
            found = [folder for folder in dated if (folder / "config.json").is_file()]
            fix = "leave out --resume, or name the run with --out"
            check(bool(found), f"there is no run {runs / name}-DATE to continue", fix=fix)
            return max(found, key=lambda folder: (folder / "config.json").stat().st_mtime)
        first = f"{name}-{datetime.date.today()}"
        names = itertools.chain([first], (f"{first}-{k}" for k in itertools.count(2)))
        return next(runs / name for name in names if not (runs / name).exists())

    def _check(self) -> None:
        if self.view:
            require_viewer()
            fix = "view a block by its folder: p2gs-jax view RUN/blocks/0"
            check(self.cluster.blocks is None, "--view does not show a fit in blocks", fix=fix)
        check(self.view or self.port == 8080, "--port has no effect without --view")
        check(0 <= self.port < 2**16, "--port must be from 0 to 65535")
        cluster, write = self.cluster, "write a whole number from 1 on, or"
        count, devices = cluster.blocks, cluster.devices
        why = "--jobs and --engine have no effect without --blocks"
        fix = "add --blocks auto, or a number"
        check(count is not None or (cluster.jobs == 1 and cluster.engine == "local"), why, fix=fix)
        valid = not isinstance(count, int) or count >= 1
        check(valid, f"--blocks {count} is not a number of blocks", fix=f"{write} auto")
        check(cluster.jobs >= 1, "--jobs must be at least 1")
        valid = self.threads is None or self.threads >= 1
        check(valid, f"--threads {self.threads} is not a number of cores", fix="give 1 or more")
        why = "--blocks fits every block on one device, and on a CPU on one core"
        fix = "leave out --devices and --threads; --jobs and --engine are for blocks"
        check(count is None or (devices == 1 and self.threads is None), why, fix=fix)
        valid = not isinstance(devices, int) or devices >= 1
        check(valid, f"--devices {devices} is not a number of devices", fix=f"{write} all")


@contextlib.contextmanager
def _naming_checkpoint(out: Path) -> Iterator[None]:
    """Note at an interruption that --resume continues, if the run or a block has a checkpoint."""
    from p2gs_jax.run.checkpoint import saved_steps
    from p2gs_jax.run.folder import RunFolder

    try:
        yield
    except KeyboardInterrupt as error:
        folders = map(RunFolder, (out, *out.glob("blocks/*")))
        if any(saved_steps(folder.checkpoints) for folder in folders):
            error.add_note("; --resume continues from the last checkpoint")
        raise


@dataclass(frozen=True, kw_only=True)
class Calibrate:
    """Solve exposures and tone curves alone, without Gaussians.

    They follow from the colours of shared points, and have standard errors. The command prints a
    table and writes photometry.json; open calibration.png first.

        p2gs-jax calibrate castle --out photometry
        p2gs-jax calibrate castle --out photometry --known-exposures exif
        p2gs-jax calibrate stack --out photometry --static
        p2gs-jax calibrate castle --out photometry --develop
    """

    SHORT_NAMES: ClassVar = (
        *("known_exposures", "exposure_sigma", "images", "drive", "cameras"),
        *("frames", "every", "max_frames", "camera_by"),
    )
    # The fields of the configuration that are options.
    FIELDS: ClassVar = (
        *("data", "loss.black", "loss.saturation", "train.seed", "photometry.known"),
        *("photometry.known_deviation_ev", "photometry.select", "photometry.model"),
        *("photometry.curve", "photometry.spline", "photometry.white_balance"),
        *("photometry.vignetting", "photometry.responses", "photometry.pivot"),
    )
    scene: Annotated[Path, tyro.conf.Positional]
    """COLMAP model, transforms.json, a folder of photographs, a video (docs/scenes.md), or a
    finished run (its rendered depth then gives the correspondences)."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")]
    """Folder for photometry.json and calibration.png."""
    compare_with: Annotated[str | None, tyro.conf.arg(metavar="FILE|exif")] = None
    """Stated exposures for comparison (default: EXIF)."""
    static: bool = False
    """Read photographs from one fixed viewpoint at several exposures."""
    develop: Literal["8bit", "16bit", "exr"] | None = None
    """Also write DIR/developed: the scene for other trainers, its photographs at one exposure and
    white balance, without vignetting (docs/exports.md)."""
    exposure_ev: Annotated[
        float | Literal["highlights"], tyro.conf.arg(metavar="STOPS|highlights")
    ] = 0.0
    """Exposure of developed photographs: stops from the mean exposure; highlights: the largest
    exposure that keeps the highlights of every photograph."""
    masks: bool = True
    """Mask pixels of developed photographs that are clipped or black in the original."""
    write_for: Annotated[
        tuple[Literal["ppisp", "3dgs", "nerfstudio"], ...], tyro.conf.arg(metavar="NAME")
    ] = ()
    """Also write the solution for other trainers: ppisp (gsplat, LichtFeld), 3dgs, nerfstudio
    (docs/exports.md)."""
    config: Config
    preset: Preset = "robust"
    """Preset of options (p2gs-jax fit --help)."""

    def execute(self) -> int:
        """Solve the photometry alone; print it as a table."""
        from p2gs_jax.cli.tables import print_calibration
        from p2gs_jax.core.progress import PlainConsole, TerminalReporter
        from p2gs_jax.export.develop import Development
        from p2gs_jax.export.trainers import write_for
        from p2gs_jax.pipeline.calibrate import calibrate, calibrate_run, calibrate_stack
        from p2gs_jax.report.development import write_development

        scene, out, cfg = self.scene, self.out, self.checked()
        with TerminalReporter() as reporter:
            how = {"compare_with": self.compare_with, "reporter": reporter}
            if self.static:
                found = calibrate_stack(scene, out, cfg, **how)
            elif self.is_run:
                found = calibrate_run(scene, out, cfg, **how)
            else:
                bits, ev, masks = self.develop, self.exposure_ev, self.masks
                development = None if bits is None else Development(bits, ev, masks)
                found = calibrate(scene, out, cfg, develop=development, **how)
            if found.developed is not None:
                write_development(out, found.developed)
        print_calibration(found, out)
        if self.write_for:
            for sentence in write_for(self.write_for, out, found.views, scene):
                PlainConsole().print(sentence, soft_wrap=True)
        return 0

    @property
    def is_run(self) -> bool:
        """Whether the scene is a finished run."""
        return all((self.scene / name).is_file() for name in ("config.json", "radiance.ply"))

    def checked(self) -> FitConfig:
        """Return the configuration; raise a UserError if a value is not valid."""
        from p2gs_jax.run.decisions import CHOSEN

        scene, is_run, cfg = self.scene, self.is_run, self.config
        given, usual = (flat(to_dict(c)) for c in (cfg, preset(self.preset)))
        whole = ("data.test_every", "data.split", "data.max_width", "data.cache_mb")
        of_stack = "--static reads all photographs of the folder, and finds limits, model and curve"
        chosen = ("data.", "loss.", "photometry.pivot", *(f"photometry.{name}" for name in CHOSEN))
        of_run = f"{scene} is a finished run, which keeps its photographs, limits and seed"
        for applies, why, unread in (
            (self.static, of_stack, chosen),
            (is_run, of_run, ("data.", "loss.", "train.seed")),
            (True, "every photograph is calibrated, and read once at its full size", whole),
        ):
            changed = [k for k in given if k.startswith(unread) and given[k] != usual[k]]
            options = " and ".join(f"--{name.replace('_', '-')}" for name in changed)
            fix = f"leave out {options}, which would have no effect"
            check(not (applies and changed), why, fix=fix)
        why, fix = "--preset has no effect with --static", "leave it out"
        check(not self.static or self.preset == Calibrate.preset, why, fix=fix)
        develops, ev = self.develop is not None, self.exposure_ev
        why = "--exposure-ev and --no-masks have no effect without --develop"
        check(develops or (ev == 0 and self.masks), why, fix="add --develop 8bit, 16bit or exr")
        check(
            isinstance(ev, str) or math.isfinite(ev), f"--exposure-ev {ev} is not a finite number"
        )
        why = "--develop needs a scene with cameras, not a run or photographs of --static"
        fix = "name the scene of the run, or leave out --develop"
        check(not (develops and (is_run or self.static)), why, fix=fix)
        return cfg


@dataclass(frozen=True)
class Inspect:
    """Inspect a scene without fitting it: cameras, frames, LiDAR, boxes, missing files.

    The command reads every format that `fit` reads. It does not start structure from motion.

        p2gs-jax inspect drive
        p2gs-jax inspect drive --cameras front front_left --frames 0:40
    """

    SHORT_NAMES: ClassVar = ("images", "drive", "cameras", "frames")
    scene: Annotated[Path, tyro.conf.Positional]
    """Scene, as for `fit`."""
    data: DataConfig = field(default_factory=DataConfig)

    def execute(self) -> int:
        """Print the contents of the scene."""
        from p2gs_jax.core.progress import PlainConsole, TerminalReporter
        from p2gs_jax.scene.survey import survey

        with TerminalReporter() as reporter:
            reporter.stage("Reading the scene")
            found = survey(self.scene, self.data, reporter.message)
        console, cameras = PlainConsole(), count_of(len(found.cameras), "camera")
        photographs = count_of(found.photographs, "photograph")
        console.print(f"{self.scene} ({found.format}): {photographs} of {cameras}.", soft_wrap=True)
        console.print(_camera_table(found))
        for line in found.sentences:
            console.print(line, soft_wrap=True)
        return 0


def _camera_table(found: Survey):
    from p2gs_jax.cli.tables import make_table

    columns = {
        "camera": [c.name for c in found.cameras],
        "photographs": [str(c.photographs) for c in found.cameras],
        "size": [f"{c.size[0]} x {c.size[1]}" for c in found.cameras],
        "focal length, px": ["" if c.focal is None else f"{c.focal:.0f}" for c in found.cameras],
        "lens": [c.lens for c in found.cameras],
        "EXIF, EV": [f"{c.ev[0]:.1f} to {c.ev[1]:.1f}" if c.ev else "" for c in found.cameras],
        "ego mask": ["" if c.ego_mask is None else f"{c.ego_mask:.1%}" for c in found.cameras],
    }
    shown = {name: cells for name, cells in columns.items() if any(cells)}
    return make_table(tuple(shown), zip(*shown.values(), strict=True), plain=True)
