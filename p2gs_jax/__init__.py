"""P2GS in JAX: photometrically consistent Gaussian splatting from ordinary photographs.

The public interface. Everything else may change between releases.
"""

from typing import TYPE_CHECKING

from p2gs_jax.config import FitConfig, preset
from p2gs_jax.errors import DivergenceError, UserError
from p2gs_jax.types import Camera, Gaussians, Params, Photometry, Render, Scene

if TYPE_CHECKING:
    from p2gs_jax.fit import fit
    from p2gs_jax.render import render_linear
    from p2gs_jax.run_folder import load_run

__all__ = [
    "Camera",
    "DivergenceError",
    "FitConfig",
    "Gaussians",
    "Params",
    "Photometry",
    "Render",
    "Scene",
    "UserError",
    "fit",
    "load_run",
    "preset",
    "render_linear",
]


def __getattr__(name: str):
    """Import what is heavy only when it is used."""
    if name == "fit":
        from p2gs_jax.fit import fit

        return fit
    if name == "load_run":
        from p2gs_jax.run_folder import load_run

        return load_run
    if name == "render_linear":
        from p2gs_jax.render import render_linear

        return render_linear
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
