"""P2GS in JAX: photometrically consistent Gaussian splatting from ordinary photographs.

The public interface. Everything else may change between releases.
"""

from importlib import import_module
from importlib.metadata import version
from typing import TYPE_CHECKING

from p2gs_jax.config import FitConfig, preset
from p2gs_jax.errors import DivergenceError, UserError

if TYPE_CHECKING:
    from p2gs_jax.districts.fit import fit_blocks
    from p2gs_jax.evaluation.alignment import exposure_error
    from p2gs_jax.jobs.configs import grid, read_sweep, with_fields
    from p2gs_jax.jobs.sweep import sweep
    from p2gs_jax.paths.shots import make_camera
    from p2gs_jax.photometry.display import DisplayTransform, develop
    from p2gs_jax.pipeline.calibrate import calibrate
    from p2gs_jax.pipeline.calibrate_of import calibrate_of
    from p2gs_jax.pipeline.calibrate_run import calibrate_run
    from p2gs_jax.pipeline.calibrate_stack import calibrate_stack
    from p2gs_jax.pipeline.fit import fit
    from p2gs_jax.render import render_linear, required_capacity
    from p2gs_jax.render.rasterization import rasterization
    from p2gs_jax.run.read import Run, load_run
    from p2gs_jax.synth.write import write_street
    from p2gs_jax.types import Camera, Gaussians, Params, Photometry, Render, Scene

__all__ = [
    "Camera",
    "DisplayTransform",
    "DivergenceError",
    "FitConfig",
    "Gaussians",
    "Params",
    "Photometry",
    "Render",
    "Run",
    "Scene",
    "UserError",
    "calibrate",
    "calibrate_of",
    "calibrate_run",
    "calibrate_stack",
    "develop",
    "exposure_error",
    "fit",
    "fit_blocks",
    "grid",
    "load_run",
    "make_camera",
    "preset",
    "rasterization",
    "read_sweep",
    "render_linear",
    "required_capacity",
    "sweep",
    "with_fields",
    "write_street",
]


_LAZY = {
    "DisplayTransform": "p2gs_jax.photometry.display",
    "Run": "p2gs_jax.run.read",
    "calibrate": "p2gs_jax.pipeline.calibrate",
    "calibrate_of": "p2gs_jax.pipeline.calibrate_of",
    "calibrate_run": "p2gs_jax.pipeline.calibrate_run",
    "calibrate_stack": "p2gs_jax.pipeline.calibrate_stack",
    "develop": "p2gs_jax.photometry.display",
    "exposure_error": "p2gs_jax.evaluation.alignment",
    "fit": "p2gs_jax.pipeline.fit",
    "fit_blocks": "p2gs_jax.districts.fit",
    "grid": "p2gs_jax.jobs.configs",
    "load_run": "p2gs_jax.run.read",
    "make_camera": "p2gs_jax.paths.shots",
    "read_sweep": "p2gs_jax.jobs.configs",
    "rasterization": "p2gs_jax.render.rasterization",
    "render_linear": "p2gs_jax.render",
    "required_capacity": "p2gs_jax.render",
    "sweep": "p2gs_jax.jobs.sweep",
    "with_fields": "p2gs_jax.jobs.configs",
    "write_street": "p2gs_jax.synth.write",
}
_LAZY |= dict.fromkeys(
    ("Camera", "Gaussians", "Params", "Photometry", "Render", "Scene"), "p2gs_jax.types"
)


def __getattr__(name: str):
    """Import what is heavy only when it is used: even the records need JAX, `--help` does not."""
    if name == "__version__":
        return version("p2gs-jax")
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_LAZY[name]), name)


def __dir__() -> list[str]:
    """List lazily imported names as well, for completion."""
    return sorted({*globals(), *__all__, "__version__"})
