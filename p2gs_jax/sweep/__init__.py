"""Sweeps: a grid or list of configurations, fitted in processes, into one table."""

from p2gs_jax.sweep.fields import grid, with_fields
from p2gs_jax.sweep.run import SweepResult, sweep
from p2gs_jax.sweep.toml import read_sweep

__all__ = ["SweepResult", "grid", "read_sweep", "sweep", "with_fields"]
