"""3DGS as Markov chain Monte Carlo: relocate transparent Gaussians, explore with noise.

Source: Kheradmand et al. 2024. The paper divides by an alternating double sum of binomials to
correct the scale of N Gaussians in one place. As 1/sqrt(k+1) = 2/sqrt(pi) int_0^inf exp(-(k+1)t^2)
dt, the sum is 2/sqrt(pi) int_0^inf (1 - (1 - o exp(-t^2))^N) dt, without cancellation (ours).
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from p2gs_jax.config import DensifyConfig
from p2gs_jax.gaussians.population import Outcome, fresh_population, logit, opacities
from p2gs_jax.render.project import rotated, rotation_matrices
from p2gs_jax.types import Gaussians, Population

# Noise is halved at this opacity and falls with this steepness (Kheradmand et al. 2024).
NOISE_OPACITY, NOISE_STEEPNESS = 0.005, 100.0
_NODES = np.linspace(0.0, 4.5, 49, dtype=np.float32)  # trapezoidal rule for this integral
_WEIGHTS = np.full(49, _NODES[1], np.float32)
_WEIGHTS[0] = _WEIGHTS[-1] = _NODES[1] / 2


def share(
    opacity: Float[Array, " n"], copies: Float[Array, " n"]
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Return opacity and scale factor for `copies` equal Gaussians that together look like one."""
    new = 1 - jnp.exp(jnp.log1p(-jnp.minimum(opacity, 1 - 1e-6)) / copies)
    behind = jnp.log1p(-new[:, None] * jnp.exp(-(_NODES**2)))
    integrand = -jnp.expm1(copies[:, None] * behind)
    denominator = 2 / np.sqrt(np.pi) * (integrand @ _WEIGHTS)
    return new, opacity / denominator


def relocate_and_grow(
    key: PRNGKeyArray,
    gaussians: Gaussians,
    population: Population,
    births: Int[Array, ""],
    cfg: DensifyConfig,
    demand: Float[Array, " n"] | None = None,
) -> Outcome:
    """Move transparent Gaussians onto opaque ones and add `births` new ones there.

    Targets are drawn in proportion to opacity times `demand` (`train/strategies.py`; None: 1).
    Gaussians in one place get the opacity (at least `cfg.prune_opacity`) and scale of `share`.
    Random moves, `cfg.spread` times their scales, separate them. Otherwise their gradients would be
    equal, and opaque ones, which get no noise, would stay together (BUILD_NOTES, "Twins").
    `refused` counts births without a free slot.
    """
    n = population.alive.shape[0]
    dead = population.alive & (opacities(gaussians) <= cfg.prune_opacity)
    healthy = population.alive & ~dead
    # Births go to the first `births` empty slots.
    order = jnp.cumsum(~population.alive) - 1
    newborn = ~population.alive & (order < births)
    weights = jnp.where(healthy, opacities(gaussians), 0.0)
    if demand is not None:
        weights = weights * demand
    movers = (dead | newborn) & jnp.any(weights > 0)
    cumulative = jnp.cumsum(weights)
    draws = jax.random.uniform(key, (n,)) * cumulative[-1]
    target = jnp.clip(jnp.searchsorted(cumulative, draws, side="right"), 0, n - 1)
    target = jnp.where(movers, target, n)
    arrivals = jnp.zeros(n, jnp.float32).at[target].add(1.0, mode="drop")
    opacity, factor = share(opacities(gaussians), 1 + arrivals)
    shared = arrivals > 0
    gaussians = dataclasses.replace(
        gaussians,
        opacity_logits=jnp.where(
            shared, logit(jnp.maximum(opacity, cfg.prune_opacity)), gaussians.opacity_logits
        ),
        log_scales=jnp.where(
            shared[:, None], gaussians.log_scales + jnp.log(factor)[:, None], gaussians.log_scales
        ),
    )
    source = jnp.where(movers, jnp.minimum(target, n - 1), jnp.arange(n))
    gaussians = jax.tree.map(lambda a: a[source], gaussians)
    # The target moves opposite to the mean of its arrivals, so that the middle of a pair stays.
    away = jax.random.normal(jax.random.fold_in(key, 1), (n, 3)) * movers[:, None]
    pushed = jnp.zeros((n, 3)).at[target].add(away, mode="drop")
    away = away - pushed / jnp.maximum(arrivals, 1)[:, None]
    gaussians = _apart(gaussians, away, movers | shared, cfg.spread)
    refused = births - jnp.sum(newborn)
    owner = None if population.owner is None else population.owner[source]
    population = fresh_population(population.alive | (newborn & movers), owner)
    return Outcome(gaussians, population, movers | shared, refused)


def _apart(
    gaussians: Gaussians, away: Float[Array, "n 3"], where: Bool[Array, " n"], spread: float
) -> Gaussians:
    """Move Gaussians within their extent, and shrink them: a pair keeps its mean extent.

    `away` holds random moves along the principal axes, in units of the scales; it is zero for
    Gaussians that stay. `where` flags those that shrink; `spread`, below 1, multiplies the moves.
    """
    scales = jnp.exp(gaussians.log_scales)
    moved = rotated(rotation_matrices(gaussians.quats), spread * away * scales)
    return dataclasses.replace(
        gaussians,
        means=gaussians.means + moved,
        log_scales=gaussians.log_scales + 0.5 * float(np.log1p(-(spread**2))) * where[:, None],
    )


def exploration_noise(
    normal: Float[Array, "n 3"],
    gaussians: Gaussians,
    alive: Bool[Array, " n"],
    rate: Float[Array, ""],
) -> Float[Array, "n 3"]:
    """Return the noise to add to the means after a step, scene units.

    The noise, a `normal` vector times each Gaussian's covariance, moves only nearly transparent
    Gaussians. `rate` is the noise scale times the learning rate of the means.
    """
    gate = jax.nn.sigmoid(NOISE_STEEPNESS * (NOISE_OPACITY - opacities(gaussians)))
    R = rotation_matrices(gaussians.quats)
    variance = jnp.exp(2 * gaussians.log_scales)
    raw = normal * (gate * alive * rate)[:, None]
    local = [sum(R[i][j] * raw[:, i] for i in range(3)) * variance[:, j] for j in range(3)]
    return rotated(R, jnp.stack(local, -1))
