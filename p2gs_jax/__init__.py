"""P2GS in JAX: photometrically consistent Gaussian splatting from ordinary photographs.

The public interface. Everything else may change between releases.
"""

import sys

if sys.argv[:1] == ["-m"]:  # `python -m p2gs_jax...` imports from the working folder first
    from p2gs_jax.core.processes import leave_out_working_folder

    leave_out_working_folder()

from importlib import import_module
from typing import Any

# Public names by module; a module is imported when one of its names is used, because `--help` must
# not import JAX.
_PUBLIC = {
    "config": ("FitConfig", "RenderConfig"),
    "core.runtime": ("use_cores",),
    "errors": ("DivergenceError", "UserError"),
    "evaluation.alignment": ("exposure_error",),
    "evaluation.evaluate": ("evaluate",),
    "gaussians.population": ("Outcome",),
    "jobs.blocks.fit": ("fit_blocks",),
    "jobs.configs": ("grid", "read_sweep", "with_fields"),
    "jobs.sweep": ("sweep",),
    "paths.shots": ("make_camera",),
    "photometry.display": ("DisplayTransform", "develop"),
    "pipeline.calibrate": ("calibrate", "calibrate_run", "calibrate_stack"),
    "pipeline.exposures": ("solve_exposures",),
    "pipeline.fit": ("fit",),
    "pipeline.prepare": ("initialise",),
    "pipeline.survey": ("survey",),
    "presets": ("preset",),
    "render": ("render_linear", "required_capacity"),
    "render.rasterization": ("rasterization",),
    "run.read": ("Run", "load_run"),
    "run.write": ("write_run",),
    "scene": ("load_scene",),
    "synth.write": ("write_street",),
    "train.make_step": ("make_step",),
    "train.terms": ("loss_terms",),
    "types": ("Camera", "Gaussians", "Params", "Photometry", "Render", "Scene"),
}
_MODULES = {name: module for module, names in _PUBLIC.items() for name in names}
__all__ = sorted(_MODULES)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return import_module("importlib.metadata").version("p2gs-jax")
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, "__version__"})
