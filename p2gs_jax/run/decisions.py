"""What a fit decides from its scene, as one record: `decisions.json`, and in every checkpoint.

The options stay as they were asked for (`config.json`). Model and curve are chosen from the
photographs, in numpy and threads: another machine may break a near tie the other way, and a state
that was optimised under one curve means little under another. So a resumed run keeps what its
checkpoints say.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any, Literal

from p2gs_jax import config
from p2gs_jax.core.atomic import plain, readable, write_json
from p2gs_jax.core.text import parse_json
from p2gs_jax.errors import UserError
from p2gs_jax.photometry.calibrate import Selection
from p2gs_jax.photometry.models import Form
from p2gs_jax.photometry.response import Response
from p2gs_jax.presets import camera_formations, with_values
from p2gs_jax.run.checkpoint import CheckpointStore
from p2gs_jax.run.folder import RunFolder

# Under this name in the metadata of checkpoints.
KEY = "decided"
# Exposures that are learned from nothing move this many times faster (docs/photometry.md, 4).
FROM_NOTHING = 10.0


@dataclass(frozen=True)
class Decisions:
    """Values that the scene settles where the options leave them open."""

    model: config.PhotometricModel  # photometric model
    curve: Literal["power", "srgb", "spline", "linear"]  # base of the tone curve
    spline: tuple[float, ...] | None  # its correction, or None
    freeze_until: float  # share of the run during which exposures and gammas keep still
    log_exposure_mean: float | None  # weight of the pull on the mean log exposure; None: no pull
    exposure_rate: float  # learning rate of the exposures
    gamma_rate: float  # learning rate of the gammas
    reasons: tuple[str, ...] = ()  # for the model and the curve, in words
    white_balance: config.Level | None = None  # per what it varies, or None
    # whether cameras have it, and per what it varies, or None
    vignetting: config.VignettingKind | None = None
    responses: config.ResponseKind = "all"  # what has a spline of its own
    # what each physical camera does; empty: nothing of its own
    cameras: tuple[config.CameraFormation, ...] = ()
    # near plane, scene units, where the one asked for would cut the scene; None elsewhere
    near: float | None = None

    @classmethod
    def as_asked(cls, cfg: config.FitConfig) -> Decisions:
        """Return what the options say before a scene is known."""
        return cls(**{name: attrgetter(place)(cfg) for name, place in _PLACES.items()})

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Decisions:
        """Return what `to_dict` and JSON made of it.

        Raises:
            KeyError, TypeError: something is missing or of another kind.
        """
        spline = values["spline"]
        kept = {f.name: values[f.name] for f in dataclasses.fields(cls)}
        kept["spline"] = None if spline is None else tuple(map(float, spline))
        kept["cameras"] = camera_formations(values["cameras"])
        return cls(**{**kept, "reasons": tuple(values["reasons"])})

    def to_dict(self) -> dict[str, Any]:
        """Return plain values."""
        return plain(dataclasses.asdict(self))

    def resolve(self, cfg: config.FitConfig) -> config.FitConfig:
        """Return the options that a fit computes under: as asked, with these values filled in."""
        values = {place: getattr(self, name) for name, place in _PLACES.items()}
        values["photometry.select"] = False
        if self.near is not None:
            values["render.near"] = self.near
        return with_values(cfg, values)

    def require_same(self, saved: dict[str, Any], folder: Path) -> None:
        """Refuse to continue a run whose checkpoints, in `folder`, have other decisions.

        Reasons may differ.

        Raises:
            UserError: a decision differs.
        """
        now = self.to_dict()
        del now["reasons"]
        other = [f"{k} was {saved.get(k)}, now {v}" for k, v in now.items() if saved.get(k) != v]
        if other:
            why = f"The checkpoints in {folder} were made under other decisions than this scene "
            why += f"leads to now: {'; '.join(other)}."
            fix = "restore the scene as it was when the run began, or start again in another "
            fix += "folder with --out"
            raise UserError(why, fix=fix)


# Options that the scene settles, by the names of the decisions.
_PLACES = {
    "model": "photometry.model",
    "curve": "photometry.curve",
    "spline": "photometry.spline",
    "freeze_until": "photometry.freeze_until",
    "log_exposure_mean": "loss.regularizers.log_exposure_mean",
    "exposure_rate": "optimizer.exposures",
    "gamma_rate": "optimizer.gammas",
    "white_balance": "photometry.white_balance",
    "vignetting": "photometry.vignetting",
    "responses": "photometry.responses",
    "cameras": "photometry.cameras",
}


def write_decisions(path: Path, decisions: Decisions) -> None:
    """Write `decisions.json`."""
    write_json(path, decisions.to_dict())


def read_decisions(path: Path) -> Decisions | None:
    """Read `decisions.json`; None where there is no such file.

    Raises:
        UserError: it is broken.
    """
    if not path.exists():
        return None
    fix = "restore it from a copy, or finish the fit again with --resume, which writes it"
    with readable(path, fix):
        return Decisions.from_dict(parse_json(path.read_text(encoding="utf-8")))


def decide(cfg: config.FitConfig, selection: Selection | None, kept: Decisions | None) -> Decisions:
    """Return what the photographs decided.

    Where the checkpoints of a run that is resumed are `kept`, what its cameras do stays to the
    digit.
    """
    decided = Decisions.as_asked(cfg)
    if selection is None:
        decided = unsolved(decided)
        return without_tracks(decided) if cfg.photometry.start == "tracks" else decided
    s = selection.solution
    form = Form(s.model, s.white_balance_level, s.vignetting)
    decided = dataclasses.replace(
        with_choice(decided, form, s.response),
        reasons=tuple(selection.reasons),
        cameras=s.cameras if kept is None else kept.cameras,
    )
    if cfg.photometry.known is None:
        return decided
    # Known exposures that are to be kept are not learned, and nothing pulls at their mean.
    keep = cfg.photometry.known_deviation_ev == 0
    return dataclasses.replace(
        decided, log_exposure_mean=None, freeze_until=1.0 if keep else decided.freeze_until
    )


def likely(cfg: config.FitConfig, kept: Decisions | None, near: float | None) -> Decisions | None:
    """Return what most scenes decide, to compile for it beforehand; None: who knows.

    `near` is the near plane, where that is decided.
    """
    p, relative = cfg.photometry, cfg.loss.relative_exposure
    if p.known is not None or relative.weight is not None or cfg.densify.method != "mcmc":
        return None
    # What cameras do enters the programs, and is not solved yet.
    solved = p.start == "tracks" and (p.vignetting is not None or p.responses != "all")
    if kept is None and not p.select and solved:
        return None
    decided = dataclasses.replace(Decisions.as_asked(cfg), near=near)
    if kept is not None:
        chosen = ("model", "curve", "spline", "white_balance", "vignetting", "responses", "cameras")
        return dataclasses.replace(decided, **{name: getattr(kept, name) for name in chosen})
    if p.start != "tracks":
        return unsolved(decided)
    if p.select:
        return dataclasses.replace(
            decided, model="view_exposure", white_balance=None, vignetting=None, responses="all"
        )
    return decided


def with_choice(decided: Decisions, form: Form, response: Response) -> Decisions:
    """Return the decisions under a form and a curve; what cameras do follows from the solution."""
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
    """Return the decisions without what only a solution can give; views may still learn theirs."""
    by_view = decided.white_balance == "view"
    return dataclasses.replace(
        decided, white_balance="view" if by_view else None, vignetting=None, responses="all"
    )


def without_tracks(decided: Decisions) -> Decisions:
    """Return the decisions for exposures learned from nothing: from the first step, and fast."""
    return dataclasses.replace(
        decided,
        freeze_until=0.0,
        exposure_rate=FROM_NOTHING * decided.exposure_rate,
        gamma_rate=FROM_NOTHING * decided.gamma_rate,
    )


def kept_choice(cfg: config.FitConfig, folder: RunFolder) -> Decisions | None:
    """Return what the checkpoints of a run remember; None: nothing was found, or there are none."""
    p = cfg.photometry
    solved = p.vignetting is not None or p.responses != "all"
    if not ((p.select or solved) and p.start == "tracks"):
        return None
    saved = (CheckpointStore(folder.checkpoints).latest_meta() or {}).get(KEY)
    return None if saved is None else Decisions.from_dict(saved)
