"""What can be refused is refused before anything is written: a wrong option costs no run folder."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from p2gs_jax.config import FitConfig, PhotometryConfig
from p2gs_jax.config import from_dict as config_from_dict
from p2gs_jax.config import to_dict as config_to_dict
from p2gs_jax.core.atomic import plain
from p2gs_jax.core.text import parse_json
from p2gs_jax.errors import UserError
from p2gs_jax.evaluation.lpips import LpipsWeights, read_lpips_weights
from p2gs_jax.evaluation.references import Reference, check_reference, load_reference
from p2gs_jax.losses.total import SECOND_RENDER_FORMS
from p2gs_jax.run.folder import RunFolder
from p2gs_jax.scene.exposures import check_source, read_known_exposures
from p2gs_jax.scene.pixels.store import size_at
from p2gs_jax.train.schedule import shrinks
from p2gs_jax.train.strategies import check_spread
from p2gs_jax.types import Scene, View


@dataclass(frozen=True)
class Paths:
    """What a fit reads and writes.

    Attributes:
        scene: folder or file that is fitted.
        run: the run folder.
        reference: photographs of the same views under one common exposure, or None.
    """

    scene: Path
    run: Path
    reference: Path | None = None


def preflight(cfg: FitConfig, paths: Paths, *, resume: bool = False) -> LpipsWeights | None:
    """Refuse what can be refused without the scene; nothing is written.

    Args:
        cfg: everything.
        paths: of the fit.
        resume: continue the run that the folder holds.

    Returns:
        The weights of LPIPS, where they are asked for.

    Raises:
        UserError: an option contradicts another, a file it names cannot be used, or the run folder
            holds another run.
    """
    check_spread(cfg.densify)
    check_start(cfg.photometry, cfg.preset)
    check_run_dir(paths.run, resume, cfg)
    check_source(cfg.photometry.known)
    check_reference(paths.reference)
    path = cfg.evaluation.lpips_weights
    return None if path is None else read_lpips_weights(path)


@dataclass(frozen=True)
class Views:
    """What a scene's views are to a fit.

    Attributes:
        truth: photographs under one common exposure, or None.
    """

    truth: Reference | None


def check_scene(
    scene: Scene, cfg: FitConfig, paths: Paths, lpips_weights: LpipsWeights | None
) -> Views:
    """Refuse what can be refused before exposures are solved; nothing is written.

    Args:
        scene: from `prepare.load`.
        cfg: everything.
        paths: of the fit.
        lpips_weights: from `preflight`.

    Raises:
        UserError: the options do not suit the views.
    """
    training = scene.training_views
    if lpips_weights is not None:
        lpips_weights.require_sizes(scene.views, cfg.data.max_width)
    if cfg.photometry.known is not None:
        read_known_exposures(cfg.photometry.known, training)
    check_sizes(training, cfg)
    truth = None if paths.reference is None else load_reference(paths.reference, scene, cfg)
    return Views(truth)


def check_start(p: PhotometryConfig, preset: str) -> None:
    """Refuse a start of the exposures that the rest of the photometry contradicts.

    Args:
        p: the image formation model.
        preset: what the options started from.

    Raises:
        UserError: known exposures or the curve do not go with it.
    """
    if p.known is not None and p.start != "tracks":
        raise UserError(
            f"the preset {preset!r} starts exposures at random: known ones would be ignored.",
            fix="leave out --known-exposures, or add --photometry.start tracks",
        )
    if p.appearance == "ppisp" and p.curve != "linear":
        raise UserError(
            f"ppisp learns a whole camera: the curve {p.curve!r} would come before it.",
            fix="use --preset ppisp, or add --photometry.curve linear --photometry.start random",
        )
    if p.appearance == "luminance" and p.curve != "linear":
        raise UserError(
            f"Luminance-GS maps display values to display values: it knows no curve {p.curve!r}.",
            fix="use --preset luminance_gs, or add --photometry.curve linear --photometry.start "
            "random",
        )
    if p.curve == "linear" and p.start == "tracks":
        raise UserError(
            "the curve 'linear' splats display values; the tracks' bundle adjustment does not know "
            "it.",
            fix="add --photometry.start random, or use the preset ppisp or one of 3dgs*",
        )


def check_sizes(views: Sequence[View], cfg: FitConfig) -> None:
    """Refuse to subtract images of different sizes.

    Args:
        views: training views.
        cfg: which reading of the relative-exposure loss there is, and the sizes of a run.

    Raises:
        UserError: the reading subtracts renders of two views, and their sizes differ.
    """
    relative = cfg.loss.relative_exposure
    if relative.weight is None or relative.form not in SECOND_RENDER_FORMS:
        return
    for shrink in reversed(shrinks(cfg.train)):
        sizes: dict[tuple[int, int], str] = {}
        for view in views:
            sizes.setdefault(size_at(view, cfg.data.max_width, shrink), view.name)
        if len(sizes) > 1:
            (a, first), (b, second) = list(sizes.items())[:2]
            raise UserError(
                f"the reading {relative.form!r} of the relative-exposure loss subtracts renders of "
                f"two views pixel by pixel, and {first} is {a[0]}x{a[1]} where {second} is "
                f"{b[0]}x{b[1]}.",
                fix="use --loss.relative-exposure.form literal_same_pose or observed_ldr, or "
                "photographs of one size",
            )


def check_run_dir(run_dir: Path, resume: bool, cfg: FitConfig) -> None:
    """Refuse to overwrite a run, and to continue one under other options.

    Options of the evaluation and the memory for photographs may differ: they do not change the fit.
    An option that the run's own version did not have counts as its default.

    Raises:
        UserError: the folder holds a run and `resume` is not set, is not a folder, or holds a run
            that was begun with other options.
    """
    if run_dir.exists() and not run_dir.is_dir():
        raise UserError(f"{run_dir} is a file.", fix="name a folder with --out")
    path = RunFolder(run_dir).config
    if not path.exists():
        return
    if not resume:
        raise UserError(
            f"{run_dir} already holds a run.",
            fix="add --resume to continue it, or name another folder with --out",
        )
    try:
        saved = plain(config_to_dict(config_from_dict(parse_json(path.read_text())["fit"])))
    except json.JSONDecodeError as error:
        raise UserError(
            f"{path} cannot be read ({error}).",
            fix="remove it and repeat the options the run was begun with: --resume then goes on",
        ) from error
    except (ValueError, KeyError, TypeError) as error:
        raise UserError(
            f"{path} cannot be read ({error}).", fix="start again in another folder"
        ) from error
    now = plain(config_to_dict(cfg))
    for options in (saved, now):
        options.pop("evaluation", None)
        options.get("data", {}).pop("cache_mb", None)
    other = _differences(saved, now)
    if other:
        raise UserError(
            f"{run_dir} was begun with other options: {'; '.join(other[:6])}.",
            fix="repeat the options it was begun with, or name another folder with --out",
        )


def _differences(saved: dict, now: dict, prefix: str = "") -> list[str]:
    """Return "name: then, now" for every value that differs."""
    out = []
    for key in sorted(set(saved) | set(now)):
        a, b = saved.get(key), now.get(key)
        if isinstance(a, dict) and isinstance(b, dict):
            out += _differences(a, b, f"{prefix}{key}.")
        elif a != b:
            out.append(f"{prefix}{key} was {a}, now {b}")
    return out
