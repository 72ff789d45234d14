"""P2GS in JAX: photometrically consistent Gaussian splatting from ordinary photographs.

The public interface. Everything else may change between releases.
"""

import ast
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

# What a name needs is imported when the name is used: `--help` needs no JAX. Type checkers read the
# block as it is, and `__getattr__` looks up in it where each name comes from.
if TYPE_CHECKING:
    from p2gs_jax.config import FitConfig as FitConfig
    from p2gs_jax.config import RenderConfig as RenderConfig
    from p2gs_jax.errors import DivergenceError as DivergenceError
    from p2gs_jax.errors import UserError as UserError
    from p2gs_jax.evaluation.alignment import exposure_error as exposure_error
    from p2gs_jax.evaluation.evaluate import evaluate as evaluate
    from p2gs_jax.gaussians.population import Outcome as Outcome
    from p2gs_jax.jobs.blocks.fit import fit_blocks as fit_blocks
    from p2gs_jax.jobs.configs import grid as grid
    from p2gs_jax.jobs.configs import read_sweep as read_sweep
    from p2gs_jax.jobs.configs import with_fields as with_fields
    from p2gs_jax.jobs.sweep import sweep as sweep
    from p2gs_jax.paths.shots import make_camera as make_camera
    from p2gs_jax.photometry.display import DisplayTransform as DisplayTransform
    from p2gs_jax.photometry.display import develop as develop
    from p2gs_jax.pipeline.calibrate import calibrate as calibrate
    from p2gs_jax.pipeline.calibrate import calibrate_run as calibrate_run
    from p2gs_jax.pipeline.calibrate import calibrate_stack as calibrate_stack
    from p2gs_jax.pipeline.convert import calibrate_of as calibrate_of
    from p2gs_jax.pipeline.exposures import solve_exposures as solve_exposures
    from p2gs_jax.pipeline.fit import fit as fit
    from p2gs_jax.pipeline.prepare import initialise as initialise
    from p2gs_jax.pipeline.survey import survey as survey
    from p2gs_jax.presets import preset as preset
    from p2gs_jax.render import render_linear as render_linear
    from p2gs_jax.render import required_capacity as required_capacity
    from p2gs_jax.render.rasterization import rasterization as rasterization
    from p2gs_jax.run.read import Run as Run
    from p2gs_jax.run.read import load_run as load_run
    from p2gs_jax.run.write import write_run as write_run
    from p2gs_jax.scene import load_scene as load_scene
    from p2gs_jax.synth.write import write_street as write_street
    from p2gs_jax.train.make_step import make_step as make_step
    from p2gs_jax.train.terms import loss_terms as loss_terms
    from p2gs_jax.types import Camera as Camera
    from p2gs_jax.types import Gaussians as Gaussians
    from p2gs_jax.types import Params as Params
    from p2gs_jax.types import Photometry as Photometry
    from p2gs_jax.types import Render as Render
    from p2gs_jax.types import Scene as Scene


def _modules() -> dict[str, tuple[str, str]]:
    """Return the module and the name there of each public name, as the block above has them."""
    source = ast.parse(Path(__file__).read_text(encoding="utf-8"))
    block = next(node for node in source.body if isinstance(node, ast.If))
    lines = [line for line in block.body if isinstance(line, ast.ImportFrom)]
    return {a.asname or a.name: (str(li.module), a.name) for li in lines for a in li.names}


_MODULES = _modules()
__all__ = sorted(_MODULES)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str):
    if name == "__version__":
        return version("p2gs-jax")
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, there = _MODULES[name]
    return getattr(import_module(module), there)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, "__version__"})
