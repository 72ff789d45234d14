"""`densify.method` adaptive: the 3DGS schedule of clones, splits, pruning and opacity resets."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from p2gs_jax.gaussians import adaptive
from p2gs_jax.gaussians.population import bucket_for
from p2gs_jax.train.host import HostState
from p2gs_jax.train.optimizer import zero_opacity_moments
from p2gs_jax.train.state import FitState, grow_state, replace_gaussians
from p2gs_jax.train.strategies.base import Strategy

_propose = jax.jit(adaptive.propose, static_argnames="cfg")
_apply = jax.jit(adaptive.apply)


class Adaptive(Strategy):
    """Kerbl et al. 2023; the paper's. Slots follow the population."""

    slots_stay = False

    def densify(self, state: FitState, host: HostState) -> FitState:
        """Prune, clone and split; reset opacities where it is time to."""
        d = self.run.cfg.densify
        gaussians, population = state.params.gaussians, state.population
        prune_large = host.reset_at > 0
        proposal = _propose(gaussians, population, self.run.extent, prune_large, cfg=d)
        state, proposal = self._with_slots(state, proposal)
        outcome = _apply(self.key(host), state.params.gaussians, state.population, proposal)
        state = self.settled(state, outcome, host)
        if host.progress - host.reset_at >= max(d.reset_every, d.min_reset_steps * host.pace):
            host.reset_at = host.progress
            state = replace_gaussians(
                state,
                adaptive.reset_opacities(state.params.gaussians),
                state.population,
                zero_opacity_moments(state.opt_state),
            )
        return state

    def _with_slots(
        self, state: FitState, proposal: adaptive.Proposal
    ) -> tuple[FitState, adaptive.Proposal]:
        """Return both with as many slots as the proposal wants and the bound allows."""
        before = state.params.gaussians.capacity
        capacity = bucket_for(int(proposal.wanted), before, self.limit)
        if self.limit is not None:
            capacity = min(capacity, max(self.limit, before))
        if capacity <= before:
            return state, proposal
        new = jnp.zeros(capacity - before, bool)
        longer = jax.tree.map(lambda a: jnp.concatenate([a, new]) if a.ndim else a, proposal)
        return grow_state(state, capacity), longer
