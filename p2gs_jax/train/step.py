"""One optimisation step: loss, gradient, optax update, statistics; pure jitted functions."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Hashable
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int

from p2gs_jax.config import FitConfig
from p2gs_jax.core.numerics import on_host
from p2gs_jax.core.streams import noise_key
from p2gs_jax.losses.regularizers import population_terms
from p2gs_jax.losses.total import Partner, decoded, image_loss, partner_cameras
from p2gs_jax.render.blocks import Shown, splat, splat_listed, whole_blocks
from p2gs_jax.render.capacity import Room
from p2gs_jax.render.spherical_harmonics import coefficient_count
from p2gs_jax.render.visible import compact, in_view
from p2gs_jax.render.xla_cpu import compiler_options
from p2gs_jax.train.optimizer import Optimizer, OptState, learning_rates, means_rate
from p2gs_jax.train.state import (
    FAULT_NONE,
    FAULT_NONFINITE,
    FAULT_OVERFLOW,
    Fault,
    FitState,
)
from p2gs_jax.train.update import update_listed
from p2gs_jax.types import Batch, Frustum, Gaussians, Params, Photometry, Population


class Controls(eqx.Module):
    """What the schedule says about this step.

    Attributes:
        progress: fraction of the run completed.
        active_degree: spherical-harmonics degree in use.
    """

    progress: Float[Array, ""]
    active_degree: Int[Array, ""]


class StepReport(NamedTuple):
    """What a step tells the host, read when the host gets round to it."""

    loss: Float[Array, ""]
    terms: dict[str, Float[Array, ""]]
    psnr: Float[Array, ""]
    entries: Int[Array, ""]
    visible: Int[Array, ""]


GRADIENT_NAMES = (
    *(f"gradient of {f.name}" for f in dataclasses.fields(Gaussians)),
    "gradient of exposures",
    "gradient of gammas",
    "gradient of appearance",
)


def finite_names(terms: dict) -> tuple[str, ...]:
    """Return the names, in the order of `Fault.term`."""
    return (*(f"loss term {k}" for k in terms), *GRADIENT_NAMES)


def _recentered(photometry: Photometry, cfg: FitConfig) -> Photometry:
    """Project the scale gauge: mean log e = 0 exactly (docs/photometry.md, 4)."""
    if photometry.parameterization != "log":
        return photometry
    if cfg.loss.regularizers.log_exposure_mean is None:
        return photometry
    raw = photometry.raw_exposures
    return dataclasses.replace(photometry, raw_exposures=raw - jnp.mean(raw))


def _rest_updated(optimizer: Optimizer, moments, rest, grads, rates, cfg: FitConfig):
    """Return photometry and appearance after a step, and their moments."""
    # optax annotates trees as nests of containers and does not know our records.
    updates, moments = optimizer.rest.update(grads, moments, rest, rates=rates)
    photometry, appearance = cast(Any, optax.apply_updates(rest, updates))
    return (_recentered(photometry, cfg), appearance), moments


def _observed(population: Population, ids, image: ImageGradient, frustum: Frustum):
    """Add this view to the densification statistics of what it shows.

    Gradients are in units of half the image, as 3DGS has them.
    """
    v_means2d = image.v_shown[0][0]
    gradient = v_means2d * jnp.stack([frustum.width / 2, frustum.height / 2])
    seen = image.visible & (jnp.sum(jnp.abs(gradient), -1) > 0)

    def added(a, b):
        return a.at[ids].add(b, mode="drop", unique_indices=True)

    return dataclasses.replace(
        population,
        grad2d_sum=added(population.grad2d_sum, jnp.linalg.norm(gradient, axis=-1)),
        seen_count=added(population.seen_count, seen.astype(jnp.float32)),
    )


class Listed(NamedTuple):
    """What a step shows.

    Attributes:
        ids: of the Gaussians that the views may show, from `compact`.
        visible: how many there are.
        shown: splats and radiance of the listed ones in each view.
    """

    ids: Int[Array, " v"]
    visible: Int[Array, ""]
    shown: tuple[Shown, ...]


class ImageGradient(NamedTuple):
    """The loss of the images and its gradients.

    Attributes:
        loss: without the terms on the Gaussians themselves.
        terms: by name.
        v_shown: gradient by what `_differentiable` takes of the splats.
        v_rest: by photometry and appearance.
        entries: tile-list entries that were needed.
        overflow: they did not fit.
        visible: which of the listed Gaussians are in the training view.
        psnr: of the view.
    """

    loss: Float[Array, ""]
    terms: dict[str, Float[Array, ""]]
    v_shown: Any
    v_rest: Any
    entries: Int[Array, ""]
    overflow: Bool[Array, ""]
    visible: Bool[Array, " v"]
    psnr: Float[Array, ""]


@dataclasses.dataclass(frozen=True, eq=False)
class Step:
    """One optimisation step as three programs, one after the other.

    The first and the last work per Gaussian and know no image size, so all levels of a fit share
    them; the one between knows neither the population nor the optimiser. In one program, every
    level compiled all of it (BUILD_NOTES, "A step is three programs").

    Attributes:
        show: (gaussians, alive, frusta, active_degree, room=, degree=) -> Listed.
        differentiate: (shown, photometry, appearance, batch, partner, room=) -> ImageGradient.
        advance: (state, ids, count, gradient, frusta, controls, degree=) -> (state, report).
        cfg: everything.
        extent: scene extent, scene units.
    """

    show: Any
    differentiate: Any
    advance: Any
    cfg: FitConfig
    extent: float

    def __call__(
        self,
        state: FitState,
        batch: Batch,
        partner: Partner,
        controls: Controls,
        *,
        room: Room,
        degree: int,
    ) -> tuple[FitState, StepReport]:
        """Take a step; see `make_step`."""
        return self.chained(
            functools.partial(self.show, room=room.visible, degree=degree),
            functools.partial(self.differentiate, room=room.entries),
            functools.partial(self.advance, degree=degree),
        )(state, batch, partner, controls)

    def frusta(self, batch: Batch, partner: Partner) -> tuple[Frustum, ...]:
        """Return the views of a step, for the programs that know no image size."""
        return tuple(
            on_host(Frustum, c.viewmat, c.K, np.float32(c.width), np.float32(c.height))
            for c in (batch.camera, *partner_cameras(partner, self.cfg))
        )

    def chained(self, show, differentiate, advance):
        """Return the step made of its three programs, compiled or not."""

        def step(state: FitState, batch: Batch, partner: Partner, controls: Controls):
            params, frusta = state.params, self.frusta(batch, partner)
            listed = show(params.gaussians, state.population.alive, frusta, controls.active_degree)
            gradient = differentiate(
                listed.shown, params.photometry, params.appearance, batch, partner
            )
            return advance(state, listed.ids, listed.visible, gradient, frusta, controls)

        return step

    def options(self, name: str) -> Hashable:
        """Return what one of the three programs, by its name, takes from the configuration.

        Neither knows the curve but `differentiate`; that does not know which exposures move.
        """
        cfg, p = self.cfg, self.cfg.photometry
        if name == "show":
            return cfg.render, cfg.optimizer.visible_only
        if name == "differentiate":
            return cfg.render, cfg.loss, dataclasses.replace(p, model="constant")
        rates = (cfg.optimizer, p.model, p.start, p.freeze_until, self.extent)
        return cfg.render, cfg.loss, cfg.densify, cfg.train.seed, rates

    def lowered(
        self, name: str, state: FitState, batch, partner, controls, *, room: Room, degree: int
    ):
        """Return one of the three programs, by its name, traced for arguments of these shapes."""
        params, frusta = state.params, self.frusta(batch, partner)
        per_gaussian = (params.gaussians, state.population.alive, frusta, controls.active_degree)
        static: dict[str, int] = {"room": room.visible, "degree": degree}
        if name == "show":
            return self.show.lower(*per_gaussian, **static)
        listed = self.show.eval_shape(*per_gaussian, **static)
        image = (listed.shown, params.photometry, params.appearance, batch, partner)
        if name == "differentiate":
            return self.differentiate.lower(*image, room=room.entries)
        gradient = self.differentiate.eval_shape(*image, room=room.entries)
        return self.advance.lower(
            state, listed.ids, listed.visible, gradient, frusta, controls, degree=degree
        )

    def compilations(self) -> int:
        """Return of the most often compiled of the three programs how often it was compiled."""
        return max(p._cache_size() for p in (self.show, self.differentiate, self.advance))


def make_step(cfg: FitConfig, optimizer: Optimizer, extent: float) -> Step:
    """Return the step `(state, batch, partner, controls, room=..., degree=...)`.

    It gives the next state and a report. A step that finds no room or whose loss is not finite
    changes nothing but `state.fault`, and so do all steps after it, until the host has dealt with
    it; where only the gradient of some Gaussians is not finite, these keep their place. Randomness
    follows from the seed and the step number alone.

    The loss is that of `total_loss`. What is done per Gaussian is done in blocks, for those that
    the view may show; the others rest (`OptimizerConfig.visible_only`).

    Args:
        cfg: everything.
        optimizer: from `make_optimizer`.
        extent: scene extent, scene units.
    """
    options = {"compiler_options": compiler_options()}
    mcmc = cfg.densify.method == "mcmc"

    @functools.partial(jax.jit, static_argnames=("room", "degree"), **options)
    def show(
        gaussians: Gaussians,
        alive: Bool[Array, " n"],
        frusta: tuple[Frustum, ...],
        active_degree: Int[Array, ""],
        *,
        room: int,
        degree: int,
    ) -> Listed:
        n = gaussians.capacity
        if cfg.optimizer.visible_only:
            may = functools.reduce(
                jnp.logical_or, (in_view(gaussians, alive, f, cfg.render) for f in frusta)
            )
            ids, count = compact(may, whole_blocks(min(room, n)))
        else:
            index = jnp.arange(whole_blocks(n), dtype=jnp.int32)
            ids, count = jnp.minimum(index, n), jnp.int32(n)
        bands = coefficient_count(degree)
        shown = splat_listed(gaussians, alive, ids, count, frusta, cfg.render, active_degree, bands)
        return Listed(ids, count, shown)

    @functools.partial(jax.jit, static_argnames="room", **options)
    def differentiate(
        shown: tuple[Shown, ...],
        photometry: Photometry,
        appearance: Float[Array, "v ..."] | None,
        batch: Batch,
        partner: Partner,
        *,
        room: int,
    ) -> ImageGradient:
        (loss, aux), (v_shown, *v_rest) = jax.value_and_grad(
            image_loss, argnums=(0, 1, 2), has_aux=True, allow_int=True
        )(shown, photometry, appearance, batch, partner, cfg, room)
        photograph, mask = decoded(batch)
        squared = mask[..., None] * (jnp.clip(aux.ldr, 0, 1) - photograph) ** 2
        mse = jnp.sum(squared) / jnp.maximum(3 * jnp.sum(mask), 1)
        return ImageGradient(
            loss,
            aux.terms,
            _differentiable(v_shown),
            tuple(v_rest),
            aux.entries,
            aux.overflow,
            aux.render.visible,
            -10 * jnp.log10(jnp.maximum(mse, 1e-10)),
        )

    @functools.partial(jax.jit, static_argnames="degree", donate_argnums=0, **options)
    def advance(
        state: FitState,
        ids: Int[Array, " v"],
        count: Int[Array, ""],
        gradient: ImageGradient,
        frusta: tuple[Frustum, ...],
        controls: Controls,
        *,
        degree: int,
    ) -> tuple[FitState, StepReport]:
        gaussians, population = state.params.gaussians, state.population
        alive = population.alive
        n, bands = gaussians.capacity, coefficient_count(degree)
        fits = ~gradient.overflow & (count <= ids.shape[0])
        first = state.fault.kind == FAULT_NONE
        healthy = first & fits & jnp.all(_finite((gradient.terms, gradient.v_rest)))

        rates = learning_rates(controls.progress, extent, state.params, cfg, bands)
        listed = jnp.sum(alive.at[ids].get(mode="fill", fill_value=False))
        updated = update_listed(
            gaussians,
            state.opt_state.gaussians[0],
            alive,
            ids,
            count,
            healthy,
            bands=bands,
            seen=lambda block, on: _differentiable(
                splat(block, on, frusta, cfg.render, controls.active_degree)
            ),
            v_seen=gradient.v_shown,
            own=lambda block, on: population_terms(block, on, cfg, extent, listed),
            optimizer=optimizer.gaussians,
            rates=rates.gaussians,
            key=noise_key(cfg.train.seed, state.step),
            noise_rate=cfg.densify.noise * means_rate(controls.progress, extent, cfg)
            if mcmc
            else None,
        )
        old_rest = (state.params.photometry, state.params.appearance)
        rest, rest_moments = _rest_updated(
            optimizer,
            state.opt_state.rest,
            old_rest,
            gradient.v_rest,
            (rates.photometry, rates.appearance),
            cfg,
        )
        if not mcmc:
            where = jnp.where(healthy, ids, n)
            population = _observed(population, where, gradient, frusta[0])

        # In the order of `finite_names`.
        terms = gradient.terms | updated.value
        checked = jnp.concatenate([_finite(terms), updated.finite, _finite(gradient.v_rest)])
        broken = FAULT_NONFINITE * ~jnp.all(checked)
        kind = jnp.where(fits, broken, FAULT_OVERFLOW).astype(jnp.int32)
        term = jnp.argmin(checked).astype(jnp.int32)
        fault = jax.tree.map(
            lambda a, b: jnp.where(first, a, b),
            Fault(kind, gradient.entries, count, term),
            state.fault,
        )
        rest, rest_moments = jax.tree.map(
            lambda new, old: jnp.where(healthy, new, old),
            (rest, rest_moments),
            (old_rest, state.opt_state.rest),
        )
        state = FitState(
            Params(updated.gaussians, *rest),
            OptState((updated.moments, optax.EmptyState()), rest_moments),
            population,
            state.step + (fault.kind == FAULT_NONE),
            fault,
        )
        loss = jax.tree.reduce(jnp.add, updated.value, gradient.loss)
        return state, StepReport(loss, terms, gradient.psnr, gradient.entries, count)

    return Step(show, differentiate, advance, cfg, extent)


def _differentiable(shown):
    """Return what the image is made of, without flags and what only bins."""
    return tuple(
        (s.means2d, s.conic_factor, s.log_opacities, s.depths, radiance) for s, radiance in shown
    )


def _finite(values) -> Bool[Array, " k"]:
    """Return whether each array of a tree is finite."""
    return jnp.stack([jnp.all(jnp.isfinite(v)) for v in jax.tree.leaves(values)])
