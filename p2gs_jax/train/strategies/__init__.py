"""Densification strategies: when the population changes, and how (gsplat's word)."""

from __future__ import annotations

from p2gs_jax.train.strategies.adaptive import Adaptive
from p2gs_jax.train.strategies.automatic import Automatic
from p2gs_jax.train.strategies.base import RunContext, Strategy
from p2gs_jax.train.strategies.mcmc import Mcmc

__all__ = ["METHODS", "RunContext", "Strategy", "make_strategy"]

# By `DensifyConfig.method`.
METHODS: dict[str | None, type[Strategy]] = {"mcmc": Mcmc, "adaptive": Adaptive, None: Strategy}


def make_strategy(run: RunContext, seeds: int) -> Strategy:
    """Return the strategy that `DensifyConfig` asks for.

    Args:
        run: what it may use.
        seeds: initial population.
    """
    d = run.cfg.densify
    kind = Automatic if d.max_gaussians == "auto" else METHODS[d.method]
    return kind(run, seeds)
