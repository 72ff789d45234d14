"""Invalid requests are refused before anything is written.

A fit that would run out of memory is refused as well. The estimate is an upper bound, measured on
fits of 1,000 and 300,000 Gaussians. It adds programs and libraries, the parameters of Gaussians,
the pixels of the largest view and the pixels of decoded photographs. On a GPU, Gaussians and the
pixels of a view are in the device's memory, which is not estimated.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import jax

from p2gs_jax.config import FitConfig, PhotometryConfig
from p2gs_jax.core.atomic import plain
from p2gs_jax.core.memory import left_to_process, ran_out, resident
from p2gs_jax.errors import UserError
from p2gs_jax.evaluation.lpips import LpipsWeights, read_lpips_weights
from p2gs_jax.evaluation.references import Reference, check_reference, load_reference
from p2gs_jax.gaussians.population import Coverage, seed_bound
from p2gs_jax.options import check_values
from p2gs_jax.photometry.models import MODELS
from p2gs_jax.photometry.response import KNOTS
from p2gs_jax.presets import flat, to_dict
from p2gs_jax.run.checkpoint import CheckpointStore
from p2gs_jax.run.decisions import CHOSEN
from p2gs_jax.run.folder import RunFolder, find, require_folder, require_free
from p2gs_jax.run.read import read_config, require_as_begun
from p2gs_jax.scene.exposures import check_source, read_known_exposures
from p2gs_jax.scene.masks import background_color
from p2gs_jax.scene.pixels.store import size_at
from p2gs_jax.scene.split import EVERY, check_every, read_split
from p2gs_jax.types import Scene

# Bytes of programs and libraries, and for each parameter, pixel of a view and decoded pixel.
PROGRAM_BYTES = 0.8e9
PARAMETER_BYTES = 37  # with moments, gradient and the copies of a densification
PIXEL_BYTES = 650
DECODED_BYTES = 7
OPTIONS = "--gaussians, --max-width or --data.cache-mb"


@dataclass(frozen=True)
class Paths:
    """Folders that a fit reads and writes; the photographs in `reference` have one exposure."""

    scene: Path
    run: Path
    reference: Path | None = None

    @classmethod
    def of(cls, scene: str | Path, run: str | Path, reference: str | Path | None = None) -> Paths:
        """Return the paths from paths or text."""
        return cls(Path(scene), Path(run), None if reference is None else Path(reference))


def preflight(cfg: FitConfig, paths: Paths, *, resume: bool = False) -> LpipsWeights | None:
    """Check the options and the folders, without the scene; nothing is written.

    The result is the weights of LPIPS, if the options name them. UserError: options contradict
    each other, a file that they name cannot be used, or the run folder holds another run or is in
    use.
    """
    require_free(paths.run)
    check_values(cfg)
    check_options(cfg)
    check_run_dir(paths.run, resume, cfg)
    check_sources(paths)
    check_source(cfg.photometry.known)
    check_reference(paths.reference)
    background_color(cfg.data)
    check_every(cfg.data.test_every)
    if cfg.data.split not in (None, EVERY):
        read_split(Path(cfg.data.split))
    name = cfg.evaluation.lpips_weights
    return None if name is None else read_lpips_weights(name)


def check_scene(
    scene: Scene, cfg: FitConfig, paths: Paths, lpips_weights: LpipsWeights | None
) -> Reference | None:
    """Check that options suit the scene, before exposures are solved; nothing is written.

    The result is the photographs under one common exposure, if there are any. UserError: the
    options do not suit the views, or the run began with other photographs or cameras.
    """
    if RunFolder(paths.run).config.exists():
        require_as_begun(paths.run, scene, cfg)
    if lpips_weights is not None:
        lpips_weights.require_sizes(scene.views, cfg.data.max_width)
    if cfg.photometry.known is not None:
        read_known_exposures(cfg.photometry.known, scene.training_views, scene.views)
    return None if paths.reference is None else load_reference(paths.reference, scene, cfg)


def check_options(cfg: FitConfig) -> None:
    """Check the options that depend on each other.

    UserError: options contradict each other, or one would have no effect.
    """
    p, share = cfg.photometry, cfg.densify.spread
    if cfg.data.split not in (None, EVERY) and not cfg.data.test_every:
        why = f"--test-every 0 holds out no view, and --split {cfg.data.split} would be ignored."
        raise UserError(why, fix="leave out one of them")
    curved, random = p.curve != "linear", "--photometry.curve linear --photometry.start random"
    if not 0 <= share < 1:
        why = f"--densify.spread {share:g} is not between 0 and 1 (1 excluded)."
        raise UserError(why, fix="give a share of the Gaussian's extent, for example 0.5")
    if p.known is not None and p.start != "tracks":
        why = "--photometry.start random, which some presets set, draws initial exposures "
        why += "and would ignore known ones."
        raise UserError(why, fix="leave out --known-exposures, or add --photometry.start tracks")
    if p.known is not None and p.parameterization == "linear":
        why = "--photometry.parameterization linear raises exposures below 0.001, also known ones."
        raise UserError(why, fix="add --photometry.parameterization log")
    if p.appearance == "ppisp" and curved:
        why = f"ppisp learns a whole camera; it does not combine with curve {p.curve!r}."
        raise UserError(why, fix=f"use --preset ppisp, or add {random}")
    if p.appearance == "luminance" and curved:
        why = f"Luminance-GS corrects display values; it does not combine with curve {p.curve!r}."
        raise UserError(why, fix=f"use --preset luminance_gs, or add {random}")
    if p.curve == "spline" and p.spline is None and p.start != "tracks":
        why = "the curve 'spline' has no values, because --photometry.start is random."
        raise UserError(why, fix="add --photometry.start tracks, or --photometry.spline VALUES")
    solved = {"vignetting": None, "responses": "all"}  # options, and values that need no solution
    solved |= {"white_balance": None} if p.white_balance == "camera" else {}
    given = {name: value for name, value in solved.items() if getattr(p, name) != value}
    if given and p.start != "tracks":
        options = [f"--photometry.{name.replace('_', '-')}" for name in given]
        why = f"{' and '.join(options)} would have no effect: --photometry.start is random."
        plain = " ".join(f"{o} {value}" for o, value in zip(options, given.values(), strict=True))
        raise UserError(why, fix=f"add --photometry.start tracks, or {plain}")
    regularizers, relative = cfg.loss.regularizers, cfg.loss.relative_exposure
    names = ("exposure_scale", "exposure_variance", "gamma_prior")
    pulls = [f"regularizers.{name}" for name in names if getattr(regularizers, name) is not None]
    # The other form of this loss also reaches the Gaussians.
    if relative.weight is not None and relative.form == "observed_ldr":
        pulls.append("relative-exposure.weight")
    if pulls and p.start == "tracks":
        why = f"--loss.{pulls[0].replace('_', '-')} has no effect: exposures are solved beforehand."
        raise UserError(why, fix="leave it out, or add --photometry.start random")
    if "camera" in MODELS[p.model][:2] and p.start != "tracks":
        why = f"the model {p.model} needs solved exposures: a fit learns those of views only."
        raise UserError(why, fix="add --photometry.start tracks, or another --photometry.model")
    if not curved and p.start == "tracks":
        why = "the curve 'linear' splats display values; it does not combine with solved exposures."
        fix = "add --photometry.start random, or use the preset ppisp or one of 3dgs*"
        raise UserError(why, fix=fix)
    check_choice(p)


def check_choice(photometry: PhotometryConfig) -> None:
    """Raise UserError: an option sets what held-out colours choose, or a spline lacks values."""
    usual, spline = PhotometryConfig(), photometry.spline
    if spline is not None and len(spline) != len(KNOTS):
        why = f"--photometry.spline has {len(spline)} values, and not {len(KNOTS)}."
        raise UserError(why, fix="give one for each knot (photometry/response.py)")
    given = [name for name in CHOSEN if getattr(photometry, name) != getattr(usual, name)]
    if photometry.select and photometry.start == "tracks" and given:
        option = f"--photometry.{given[0].replace('_', '-')}"
        why = f"{option} has no effect: held-out colours choose the model and the curve."
        raise UserError(why, fix=f"add --photometry.no-select, or leave out {option}")


def check_run_dir(run_dir: Path, resume: bool, cfg: FitConfig) -> bool:
    """Check that the folder holds no run, or with `resume` a run under the same options.

    Options of the evaluation and the memory for photographs may differ: they do not change the fit.
    Steps and budget may be larger; the result is whether they are larger than when the run began.
    UserError: the path is not a folder, holds a run and `resume` is not set, or holds a run with
    other options.
    """
    require_folder(run_dir)
    path = RunFolder(run_dir).config
    if not path.exists():
        return False
    if not resume:
        fix = "add --resume to continue it, or name another folder with --out"
        raise UserError(f"{run_dir} already holds a run.", fix=fix)
    saved, now = (flat(plain(to_dict(options))) for options in (read_config(path)[1], cfg))
    free = [name for name in now if name == "data.cache_mb" or name.startswith("evaluation.")]
    plan = [name for name in ("train.steps", "train.budget_s") if now[name] and saved.get(name)]
    longer = [name for name in plan if now[name] > saved[name]]
    compared = sorted({*saved, *now} - {*free, *longer})
    differ = [name for name in compared if saved.get(name) != now.get(name)]
    if differ:
        other = [f"{name} was {saved.get(name)}, now {now.get(name)}" for name in differ]
        fix = "repeat the options of its start (--steps and --budget may be larger), or name "
        fix += "another folder with --out"
        raise UserError(f"{run_dir} was begun with other options: {'; '.join(other[:6])}.", fix=fix)
    return bool(longer)


def require_checkpoint(folder: RunFolder) -> None:
    """Raise UserError: there is no readable checkpoint from which a finished run could continue."""
    if CheckpointStore(folder.checkpoints).latest_meta() is None:
        why = f"{folder.checkpoints} holds no readable checkpoint, so --resume would begin the "
        why += "finished run anew."
        raise UserError(why, fix="name another folder with --out")


def check_sources(paths: Paths) -> None:
    """Check that a run is continued with the scene and the reference that it was begun with.

    UserError: it was begun with others. Folders that have moved are not compared.
    """
    path = RunFolder(paths.run).config
    if not path.exists():
        return
    saved = read_config(path)[0]
    for key, now in (("scene", paths.scene), ("reference", paths.reference)):
        was = find(saved, key, paths.run)
        if was is None or now is None:
            same = was is now
        else:
            same = not (was.exists() and now.exists()) or was.samefile(now)
        if not same:
            why = f"{paths.run} was begun with the {key} {was}, now {now}."
            raise UserError(why, fix=f"name that {key}, or another folder with --out")


class MemoryNeeded(NamedTuple):
    """Bytes of memory that a fit needs at its peak, and the largest `population` (Gaussians)."""

    programs: float  # Python, libraries, compiling
    gaussians: float  # parameters, moments, gradients
    photographs: float  # decoded photographs in memory
    view: float  # images of the largest view and their gradients
    population: int

    @property
    def total(self) -> float:
        """Bytes of all parts."""
        return self.programs + self.gaussians + self.photographs + self.view


def memory_needed(scene: Scene, cfg: FitConfig, coverage: Coverage) -> MemoryNeeded:
    """Return the bytes of memory that a fit needs at its peak."""
    count = max(seed_bound(cfg, min(len(scene.points), cfg.init.max_seeds), coverage), 1)
    parameters = 11 + 3 * (cfg.render.sh_degree + 1) ** 2
    on_host = jax.default_backend() == "cpu"
    sizes = [size_at(view, cfg.data.max_width) for view in scene.views]
    decoded = sum(w * h for w, h in sizes) * DECODED_BYTES
    return MemoryNeeded(
        programs=PROGRAM_BYTES,
        gaussians=float(on_host * count * parameters * PARAMETER_BYTES),
        photographs=float(min(decoded, cfg.data.cache_mb * 2**20)),
        view=float(on_host * coverage.pixels * PIXEL_BYTES),
        population=count,
    )


def require_memory(needed: MemoryNeeded) -> None:
    """Raise UserError, which names options that help, if a fit needs more memory than there is."""
    left = left_to_process()
    if left is None or needed.total <= left + resident():
        return
    available = left + resident()
    raise UserError(
        f"this fit would take about {_gb(needed.total)} of memory at its peak ({needed.population} "
        f"Gaussians {_gb(needed.gaussians)}, photographs {_gb(needed.photographs)}, pixels of a "
        f"view {_gb(needed.view)}, programs {_gb(needed.programs)}), and {_gb(available)} is left.",
        fix=f"lower {OPTIONS}, or end other programs",
    )


@contextlib.contextmanager
def memory_named() -> Iterator[None]:
    """Turn an error about memory in a `with` block into one that names the remedy.

    UserError: memory ran out. Other errors pass unchanged.
    """
    try:
        yield
    except (MemoryError, RuntimeError, OSError) as error:
        if not ran_out(error):
            raise
        cause = str(error).splitlines()[0][:160] if str(error) else "an allocation failed"
        fix = f"lower {OPTIONS}, in a new folder, or end other programs and add --resume"
        raise UserError(f"memory ran out ({cause}).", fix=fix) from error


def _gb(size: float) -> str:
    return f"{size / 1e9:.1f} GB"
