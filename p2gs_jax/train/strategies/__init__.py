"""Densification strategies: when the population changes, and how (gsplat's word)."""

from __future__ import annotations

from p2gs_jax.config import DensifyConfig
from p2gs_jax.errors import UserError
from p2gs_jax.train.strategies.adaptive import Adaptive
from p2gs_jax.train.strategies.base import RunContext, Strategy
from p2gs_jax.train.strategies.mcmc import Mcmc

__all__ = ["METHODS", "RunContext", "Strategy", "check_spread", "make_strategy"]

# By `DensifyConfig.method`.
METHODS: dict[str | None, type[Strategy]] = {"mcmc": Mcmc, "adaptive": Adaptive, None: Strategy}


def make_strategy(run: RunContext, seeds: int) -> Strategy:
    """Return the strategy that `DensifyConfig` asks for.

    Args:
        run: what it may use.
        seeds: initial population.
    """
    return METHODS[run.cfg.densify.method](run, seeds)


def check_spread(cfg: DensifyConfig) -> None:
    """Refuse moves that no shrinking makes up for.

    Raises:
        UserError: `spread` is not in [0, 1).
    """
    if not 0 <= cfg.spread < 1:
        raise UserError(
            f"--densify.spread {cfg.spread:g} is not between 0 and 1 (1 excluded).",
            fix="give a share of a Gaussian's own extent, for example 0.5",
        )
