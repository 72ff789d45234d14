"""Densification strategies: when the population changes, and how (gsplat's word)."""

from __future__ import annotations

from p2gs_jax.train.strategies.adaptive import Adaptive
from p2gs_jax.train.strategies.automatic import Automatic
from p2gs_jax.train.strategies.base import RunContext, Strategy
from p2gs_jax.train.strategies.mcmc import Mcmc

__all__ = ["RunContext", "Strategy", "make_strategy"]


def make_strategy(run: RunContext, seeds: int) -> Strategy:
    """Return the strategy that `DensifyConfig` asks for.

    Args:
        run: what it may use.
        seeds: initial population.
    """
    d = run.cfg.densify
    if d.max_gaussians == "auto":
        return Automatic(run, seeds)
    if d.method == "mcmc":
        return Mcmc(run, seeds)
    method = Adaptive if d.method == "adaptive" else Strategy
    return method(run, seeds, limit=d.max_gaussians)
