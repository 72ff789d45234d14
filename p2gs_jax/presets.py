"""Presets, and configurations with other values, with some fields only, or from JSON.

A preset is a table of the fields that differ from `robust`, which is `FitConfig()`.
"""

from __future__ import annotations

import dataclasses
from collections import namedtuple
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar, get_args

from p2gs_jax.config import CameraFormation, FitConfig, PhotometryConfig, PresetName
from p2gs_jax.errors import UserError

Record = TypeVar("Record")
Fields = dict[str, Any]

# The method exactly as printed (results: BUILD_NOTES.md). The paper prints no rates for e and
# gamma: 1e-2 is the best of 1e-3, 1e-2 and 3e-2 (24.4, 26.5 and 25.4 dB on training views).
PAPER: Fields = {
    "render.radiance": "linear",
    "render.blur": 0.3,
    "photometry.select": False,
    "photometry.curve": "power",
    "photometry.pivot": 1.0,
    "photometry.clamp": True,
    "photometry.parameterization": "linear",
    "photometry.start": "random",
    "loss.censored": False,
    "loss.relative_exposure.weight": 0.01,
    "loss.regularizers.exposure_scale": 0.01,
    "loss.regularizers.exposure_variance": 0.1,
    "loss.regularizers.gamma_prior": 0.1,
    "loss.regularizers.log_exposure_mean": None,
    "loss.regularizers.gamma_mean_variance": None,
}
# The schedule, the rates and the renderer's limits that P2GS shares with 3DGS.
PUBLISHED: Fields = {
    "render.near": 0.2,
    "render.alpha_max": 0.99,
    "optimizer.means": 1.6e-4,
    "optimizer.means_final": 1.6e-6,
    "optimizer.scales": 5e-3,
    "optimizer.sh_dc": 2.5e-3,
    "optimizer.sh_rest": 1.25e-4,
    "optimizer.opacities": 5e-2,
    "optimizer.quats": 1e-3,
    "optimizer.final": 1.0,
    "optimizer.full_rate_updates": None,
    "optimizer.gammas": 1e-2,
    "optimizer.photometry_final": 1.0,
    "optimizer.extent": "cameras",
    "loss.near_depth": 0.0,
    "optimizer.b1": 0.9,
    "optimizer.visible_only": False,
    "densify.method": "adaptive",
    "init.opacity": 0.1,
    "init.shell": "off",
    "init.dense": "off",
    "train.steps": 30_000,
    "train.coarse_to_fine": (),
}
# 3DGS in display values: exposures start at 1 and stay there.
DISPLAY: Fields = {
    "render.radiance": "linear",
    "photometry.select": False,
    "photometry.model": "constant",
    "photometry.curve": "linear",
    "photometry.start": "random",
    "photometry.start_std": 0.0,
    "loss.censored": False,
}
# DISPLAY with the schedule, renderer and budget of `robust`. Rates of colours are 4 times the best
# of three (results/2026-11-21-photometry-on-street.md); the factor 4 was not measured
# (BUILD_NOTES, "Rates").
LDR: Fields = DISPLAY | {"optimizer.sh_dc": 2e-2, "optimizer.sh_rest": 1e-3}
PRESETS: dict[PresetName, Fields] = {
    "robust": {},
    "paper": PAPER | PUBLISHED,
    "paper_appendix": PAPER | PUBLISHED | {"loss.relative_exposure.weight": 0.1},
    "3dgs": LDR,
    "3dgs_published": PUBLISHED | {"render.blur": 0.3} | DISPLAY,
    "3dgs_gain": LDR | {"photometry.model": "view_exposure"},
    "3dgs_affine": LDR | {"photometry.appearance": "affine"},
    # Published rate: 2e-3 over 30,000 steps, at which grids do not reach widely spread exposures
    # (BUILD_NOTES, "Learned corrections at size"); ours is 1e-2.
    "3dgs_bilateral": LDR | {"photometry.appearance": "bilateral"},
    "3dgs_curve": LDR | {"photometry.appearance": "curve"},
    # PPISP without its controller. Published rate: 2e-3 over 30,000 steps; ours suits fits of a few
    # hundred to a few thousand steps (BUILD_NOTES, "PPISP").
    "ppisp": LDR
    | {
        "photometry.appearance": "ppisp",
        "loss.regularizers.appearance": 1.0,
        "optimizer.appearance": 1e-1,
        "optimizer.appearance_final": 0.01,
        "optimizer.appearance_warmup": 500 / 30_000,
    },
    # PPISP's effects of a camera, solved before the fit in our model; no model is chosen.
    "ppisp_solved": {
        "photometry.select": False,
        "photometry.model": "view_exposure",
        "photometry.curve": "spline",
        "photometry.white_balance": "view",
        "photometry.vignetting": "channel",
        "photometry.responses": "camera",
    },
    # Luminance-GS's curves. Published: 10,000 steps, rates that decay to 1 %. Our rate is 10 times
    # the published rate of the curve, for fits of a few hundred to a few thousand steps.
    "luminance_gs": LDR
    | {"photometry.appearance": "luminance", "optimizer.appearance_final": 0.01},
}


def preset(name: PresetName) -> FitConfig:
    """Return the configuration of a preset.

    The presets are `robust`; `paper` (as printed, lambda_exp 0.01) and `paper_appendix` (0.1);
    baselines on display values (`3dgs...`, `ppisp`, `luminance_gs`); `ppisp_solved`
    (docs/baselines.md). UserError: there is no such preset.
    """
    if name not in PRESETS:
        fix = f"choose {', '.join(get_args(PresetName))}"
        raise UserError(f"there is no preset {name!r}.", fix=fix)
    return with_values(FitConfig(preset=name), PRESETS[name])


def require_config(cfg: FitConfig | None) -> FitConfig:
    """Return the configuration, or `robust` for None.

    Raises UserError: `cfg` is something else, such as the name of a preset.
    """
    if cfg is None:
        return FitConfig()
    if not isinstance(cfg, FitConfig):
        fix = 'give a FitConfig, for example p2gs_jax.preset("robust")'
        raise UserError(f"{cfg!r} is not a FitConfig.", fix=fix)
    return cfg


def narrowed(record: Record, fields: Mapping[str, Any]) -> Record:
    """Return a configuration with some of its fields only; reading another raises AttributeError.

    All configurations that agree in these fields share one compiled program, which cannot depend
    on any other field. `fields` maps the name of a field to None (all of it), to the names of its
    fields, or to another such mapping.
    """
    values = {name: getattr(record, name) for name in fields}
    for name, inner in fields.items():
        if inner is not None:
            inner = inner if isinstance(inner, Mapping) else dict.fromkeys(inner)
            values[name] = narrowed(values[name], inner)
    kind: Any = type(record)
    hidden = {f.name: property() for f in dataclasses.fields(kind) if f.name not in values}
    # A named tuple compares by its fields.
    bases = (namedtuple(kind.__name__, values), kind)
    return type(kind.__name__, bases, hidden | {"__init__": object.__init__})(**values)


def with_values(record: Record, values: Mapping[str, Any]) -> Record:
    """Return a configuration with other values, by dotted names of fields, without checks."""
    for path, value in values.items():
        name, _, inner = path.partition(".")
        if inner:
            value = with_values(getattr(record, name), {inner: value})
        record = dataclasses.replace(record, **{name: value})  # pyright: ignore
    return record


def to_dict(config: FitConfig) -> dict:
    """Return the configuration as nested plain values, as in `config.json`."""
    return dataclasses.asdict(config)


def flat(options: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested values as one dictionary by dotted names."""
    out: dict[str, Any] = {}
    for name, value in options.items():
        nested = isinstance(value, dict)
        out |= flat(value, f"{prefix}{name}.") if nested else {prefix + name: value}
    return out


def from_dict(values: Mapping[str, Any], kind: Any = FitConfig) -> Any:
    """Rebuild a configuration, or a record of one, from `to_dict`'s result.

    Raises TypeError: a field is unknown to this version, or a group of fields is not an object.
    """
    kinds = {f.name: f.default_factory for f in dataclasses.fields(kind)}
    unknown = sorted(set(values) - set(kinds))
    if unknown:
        raise TypeError(f"unknown fields in {kind.__name__}: {', '.join(unknown)}")
    made = {}
    for name, value in values.items():
        if dataclasses.is_dataclass(kinds[name]) != isinstance(value, dict):
            raise TypeError(f"{kind.__name__}.{name} cannot be {value!r}")
        if isinstance(value, dict):
            value = from_dict(value, kinds[name])
        elif (kind, name) == (PhotometryConfig, "cameras"):
            value = camera_formations(value)
        made[name] = tuple(value) if isinstance(value, list) else value
    return kind(**made)


def camera_formations(values: Sequence[dict]) -> tuple[CameraFormation, ...]:
    """Rebuild cameras from the result of `dataclasses.asdict`, also after JSON.

    Raises KeyError, TypeError or ValueError: a field is missing or of another type.
    """
    return tuple(
        CameraFormation(
            str(each["name"]),
            *(tuple(tuple(map(float, row)) for row in each[k]) for k in ("vignetting", "splines")),
        )
        for each in values
    )
