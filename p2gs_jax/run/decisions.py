"""Values that a fit derives from its scene, in `decisions.json` and in every checkpoint.

The options in `config.json` stay as the user chose them. Model and curve are chosen from the
photographs, in numpy and threads: another computer may choose differently in a near tie, and a
state that was optimised under one curve does not fit another. A resumed run therefore keeps the
decisions of its checkpoints.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any, Literal

from p2gs_jax import config
from p2gs_jax.core.atomic import plain, readable
from p2gs_jax.core.text import parse_json
from p2gs_jax.errors import UserError
from p2gs_jax.photometry.calibrate import Selection
from p2gs_jax.photometry.models import Form
from p2gs_jax.photometry.response import Response
from p2gs_jax.presets import camera_formations, with_values
from p2gs_jax.run.checkpoint import CheckpointStore
from p2gs_jax.run.folder import RunFolder

# Key of the decisions in the metadata of checkpoints.
KEY = "decided"
# Options of `PhotometryConfig` that `select` replaces.
CHOSEN = ("model", "curve", "spline", "white_balance", "vignetting", "responses")
# Decisions about options of `PhotometryConfig`, under the names of these options.
_SOLVED = (*CHOSEN, "cameras", "start", "start_std")
# Options that the scene decides, by the names of the decisions.
_PLACES = {
    **{name: f"photometry.{name}" for name in _SOLVED},
    "near": "render.near",
    "near_depth": "loss.near_depth",
}


@dataclass(frozen=True)
class Decisions:
    """Values that the options leave to the scene."""

    model: config.PhotometricModel
    curve: Literal["power", "srgb", "spline", "linear"]  # base of the tone curve
    spline: tuple[float, ...] | None  # its correction, or None
    start: Literal["tracks", "random"]  # whether exposures and gammas are solved, or learned
    start_std: float  # standard deviation of the initial exposures, if they are learned
    near: float  # near plane, scene units; a closer one if that in the options would cut the scene
    reasons: tuple[str, ...] = ()  # reasons for the model and the curve, in words
    white_balance: config.Level | None = None  # level of the white balance, or None
    vignetting: config.VignettingKind | None = None  # one per camera, or per channel of a camera
    responses: config.ResponseKind = "all"  # one response for all, or per camera or channel
    # vignetting and response of each physical camera, if any
    cameras: tuple[config.CameraFormation, ...] = ()
    near_depth: float | None = None  # depth below which gradients are scaled, scene units, or None

    @classmethod
    def as_given(cls, cfg: config.FitConfig) -> Decisions:
        """Return the values of the options, before a scene is known."""
        return cls(**{name: attrgetter(place)(cfg) for name, place in _PLACES.items()})

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Decisions:
        """Return decisions from the result of `to_dict`, also after JSON.

        Raises KeyError or TypeError: a value is missing or of another type.
        """
        spline = values["spline"]
        kept = {f.name: values[f.name] for f in dataclasses.fields(cls)}
        kept["spline"] = None if spline is None else tuple(map(float, spline))
        kept["cameras"], kept["near"] = camera_formations(values["cameras"]), float(values["near"])
        return cls(**{**kept, "reasons": tuple(values["reasons"])})

    def to_dict(self) -> dict[str, Any]:
        """Return plain values."""
        return plain(dataclasses.asdict(self))

    def resolve(self, cfg: config.FitConfig) -> config.FitConfig:
        """Return the options of a fit: the user's options with these values filled in."""
        values = {place: getattr(self, name) for name, place in _PLACES.items()}
        values["photometry.select"] = False
        return with_values(cfg, values)

    def require_same(self, saved: dict[str, Any], folder: Path) -> None:
        """Raise UserError if checkpoints in `folder` have other decisions; reasons may differ."""
        now = self.to_dict()
        del now["reasons"]
        other = [f"{k} was {saved.get(k)}, now {v}" for k, v in now.items() if saved.get(k) != v]
        if other:
            why = f"The decisions in the checkpoints of {folder} differ from those that the scene "
            why += f"gives now: {'; '.join(other)}."
            fix = "restore the scene as it was when the run began, or start again in another "
            fix += "folder with --out"
            raise UserError(why, fix=fix)


def read_decisions(path: Path) -> Decisions | None:
    """Read `decisions.json`; None: there is no such file; UserError: it is broken."""
    if not path.exists():
        return None
    fix = "restore it from a copy, or finish the fit again with --resume, which writes it"
    with readable(path, fix):
        return Decisions.from_dict(parse_json(path.read_text(encoding="utf-8")))


def decide(cfg: config.FitConfig, selection: Selection | None, kept: Decisions | None) -> Decisions:
    """Return the decisions from the photographs.

    A resumed run keeps vignetting and responses of its checkpoints (`kept`) bit for bit.
    """
    decided = Decisions.as_given(cfg)
    if selection is None:
        return unsolved(decided)
    s = selection.solution
    form = Form(s.model, s.white_balance_level, s.vignetting)
    return dataclasses.replace(
        with_choice(decided, form, s.response),
        reasons=tuple(selection.reasons),
        cameras=s.cameras if kept is None else kept.cameras,
    )


def likely(
    cfg: config.FitConfig, kept: Decisions | None, scale: Mapping[str, float | None]
) -> Decisions | None:
    """Return the most frequent decisions, to compile for them early; None: unpredictable.

    `scale` has the decisions that follow from the depths of the scene.
    """
    p, relative = cfg.photometry, cfg.loss.relative_exposure
    if p.known is not None or relative.weight is not None or cfg.densify.method != "mcmc":
        return None
    # Vignetting and responses of cameras are constants of the programs, but not yet solved.
    camera_effects = p.start == "tracks" and (p.vignetting is not None or p.responses != "all")
    if kept is None and not p.select and camera_effects:
        return None
    decided = dataclasses.replace(Decisions.as_given(cfg), **scale)
    if kept is not None:
        return dataclasses.replace(decided, **{name: getattr(kept, name) for name in _SOLVED})
    if p.start != "tracks":
        return unsolved(decided)
    if p.select:
        return dataclasses.replace(
            decided, model="view_exposure", white_balance=None, vignetting=None, responses="all"
        )
    return decided


def with_choice(decided: Decisions, form: Form, response: Response) -> Decisions:
    """Return the decisions under a form and a curve; `cameras` follow from the solution."""
    return dataclasses.replace(
        decided,
        model=form.model,
        curve=response.curve,
        spline=response.spline,
        white_balance=form.white_balance,
        vignetting=form.vignetting,
        responses=response.by,
    )


def unsolved(decided: Decisions) -> Decisions:
    """Return the decisions without a solution: exposures are learned, and start at 1 if not random.

    A white balance per view is learned as well. A spline without values becomes sRGB.
    """
    lost = decided.curve == "spline" and decided.spline is None
    by_view = decided.white_balance == "view"
    return dataclasses.replace(
        decided,
        start="random",
        curve="srgb" if lost else decided.curve,
        start_std=decided.start_std if decided.start == "random" else 0.0,
        white_balance="view" if by_view else None,
        vignetting=None,
        responses="all",
    )


def kept_choice(cfg: config.FitConfig, folder: RunFolder) -> Decisions | None:
    """Return the decisions in the checkpoints of a run; None: nothing was solved or saved.

    UserError: another version of the program wrote the checkpoints.
    """
    p = cfg.photometry
    camera_effects = p.vignetting is not None or p.responses != "all"
    if not ((p.select or camera_effects) and p.start == "tracks"):
        return None
    saved = (CheckpointStore(folder.checkpoints).latest_meta() or {}).get(KEY)
    try:
        return None if saved is None else Decisions.from_dict(saved)
    except (KeyError, TypeError) as error:
        why = f"The checkpoints in {folder.checkpoints} belong to another version: {error!r}."
        fix = "resume with the version of the run, or start again in another folder with --out"
        raise UserError(why, fix=fix) from error
