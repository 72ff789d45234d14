"""The three parts of a step of several views, as one device of the mesh runs them.

Within a device everything is as in a step of one view, view by view. Between devices splats and
their gradients travel along the Gaussians' axis (`exchange`), and sums of gradients by parameters
along the views' axis. The loss is the mean over the views; learning rates are those of one view
times the root of their number, so that as many views move a Gaussian about as far (Krizhevsky 2014;
Grendel-GS, arXiv 2406.18533; docs/scaling.md).
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from p2gs_jax.config import FitConfig, RenderConfig
from p2gs_jax.core.devices import AXES, GAUSSIANS, VIEWS
from p2gs_jax.core.streams import noise_key
from p2gs_jax.gaussians.mcmc import shaped_noise
from p2gs_jax.losses.regularizers import population_terms
from p2gs_jax.losses.total import Partner
from p2gs_jax.photometry.appearance import Corrections
from p2gs_jax.render.harmonics import coefficient_count
from p2gs_jax.render.visible import (
    block_size,
    compact,
    owners_at,
    slice_of,
    splat,
    take_rows,
    whole_blocks,
)
from p2gs_jax.train import image_gradient
from p2gs_jax.train.advance import Controls, Moved, StepReport, is_healthy, settled
from p2gs_jax.train.image_gradient import ImageGradient, differentiable
from p2gs_jax.train.mesh.exchange import to_gaussians, to_views
from p2gs_jax.train.object_poses import MovedPoses
from p2gs_jax.train.optimizer import Optimizer, learning_rates, means_rate
from p2gs_jax.train.state import FitState
from p2gs_jax.train.update import update_listed
from p2gs_jax.types import Batch, Frustum, Gaussians, Photometry, Population


class ListedViews(NamedTuple):
    """What the views of a group show.

    Attributes:
        ids: of the device's own Gaussians, by view of the group, from `compact`.
        visible: how many there are, by view.
        shown: splats and radiance in the device's views, of all Gaussians of the group.
    """

    ids: Int[Array, "g v"]
    visible: Int[Array, "g 1"]
    shown: Any


def show(
    gaussians: Gaussians,
    alive: Array,
    frusta: tuple[Frustum, ...],
    active_degree: Int[Array, ""],
    owner: Array | None,
    *,
    cfg: RenderConfig,
    visible_only: bool,
    room: int,
    degree: int,
    parts: int,
) -> ListedViews:
    """List what each view of the group may show, project it, and send it where it is composited.

    Args:
        gaussians: those of the device.
        alive: of these.
        frusta: of the group's views, stacked; a tuple as in `image_gradient.show`.
        active_degree: spherical-harmonics degree in use.
        owner: the moving object that each belongs to, or None.
        cfg: rendering options.
        visible_only: see `image_gradient.show`.
        room: Gaussians that one view may show, of all devices.
        degree: highest degree that is evaluated.
        parts: devices of a group.
    """

    def one(views):
        return image_gradient.show(
            gaussians,
            alive,
            views,
            active_degree,
            owner,
            cfg=cfg,
            visible_only=visible_only,
            room=-(-room // parts),
            degree=degree,
        )

    listed = lax.map(one, frusta)
    return ListedViews(listed.ids, listed.visible[:, None], to_views(listed.shown, parts))


def differentiate(
    shown: Any,
    photometry: Photometry,
    appearance: Corrections | None,
    batch: Batch,
    partner: Partner,
    *,
    cfg: FitConfig,
    room: int,
    views: int,
) -> ImageGradient:
    """Return the mean loss of all views, and its gradient; by splats, those of the own views.

    Gradients by splats are those of a view's own loss; `advance` takes their mean.

    Args:
        shown: from `show`.
        photometry: of all views of the fit.
        appearance: corrections, or None.
        batch: the device's views, stacked.
        partner: of each.
        cfg: rendering, loss and formation model.
        room: length of the tile lists.
        views: of the step.
    """

    def one(given):
        mine, photograph, second = given
        return image_gradient.differentiate(
            mine, photometry, appearance, photograph, second, cfg=cfg, room=room
        )

    each = lax.map(one, (shown, batch, partner))

    def mean(tree):
        return jax.tree.map(lambda a: lax.psum(jnp.sum(a, 0), AXES) / views, tree)

    return ImageGradient(
        mean(each.loss),
        mean(each.terms),
        each.v_shown,
        mean(each.v_rest),
        lax.pmax(jnp.max(each.entries), AXES),
        lax.pmax(jnp.max(each.overflow.astype(jnp.int32)), AXES) > 0,
        each.visible,
        mean(each.psnr),
    )


class Sums(NamedTuple):
    """What the views of a step add up to, for the Gaussians of a device.

    Attributes:
        gradient: of the sum of the views' losses.
        shown: views that may show each.
        grad2d: norms of the gradients by the place on the screen, in units of half the image.
        pulled: views in which that was not zero.
    """

    gradient: Gaussians
    shown: Int[Array, " n"]
    grad2d: Float[Array, " n"]
    pulled: Float[Array, " n"]


def advance(
    state: FitState,
    ids: Int[Array, "g v"],
    visible: Int[Array, "g 1"],
    gradient: ImageGradient,
    frusta: tuple[Frustum, ...],
    controls: Controls,
    *,
    cfg: FitConfig,
    optimizer: Optimizer,
    extent: float,
    degree: int,
    views: int,
    parts: int,
) -> tuple[FitState, StepReport]:
    """Move the device's Gaussians, and what all devices have, by one step.

    Args:
        state: before the step, of the device; donated.
        ids: from `show`.
        visible: likewise.
        gradient: from `differentiate`.
        frusta: as in `show`.
        controls: of the schedule.
        cfg: rendering, the terms on the Gaussians, rates, noise.
        optimizer: from `make_optimizer`.
        extent: scene extent, scene units.
        degree: highest spherical-harmonics degree that moves.
        views: of the step.
        parts: devices of a group.
    """
    gaussians, population = state.params.gaussians, state.population
    alive, n, bands = population.alive, gaussians.capacity, coefficient_count(degree)
    # As one view of one device: the largest of all, times the devices that share it.
    most = parts * lax.pmax(jnp.max(visible), AXES)
    fits = ~gradient.overflow & (most <= parts * ids.shape[1])
    healthy = is_healthy(state, gradient, fits)

    sums = _sums(state, ids, visible, gradient, frusta, controls, cfg, bands, parts)
    seen, count = compact((sums.shown > 0) & alive, whole_blocks(n))
    listed = lax.psum(jnp.sum((sums.shown > 0) & alive), GAUSSIANS)

    progress, rate = controls.progress, controls.rate
    rates = learning_rates(progress, rate, extent, state.params, cfg, bands)
    rates = jax.tree.map(lambda r: r * views**0.5, rates)
    mcmc = cfg.densify.method == "mcmc"
    updated = update_listed(
        gaussians,
        state.opt_state.gaussians[0],
        alive,
        seen,
        count,
        healthy,
        bands=bands,
        # Their gradient is known: a Gaussian is what it is made of.
        seen=lambda block, on, owner, placed: block,
        v_seen=jax.tree.map(lambda g: g / views, take_rows(sums.gradient, seen, bands)),
        own=lambda block, on: population_terms(block, on, cfg, extent, listed),
        optimizer=optimizer.gaussians,
        rates=rates.gaussians,
        noise=_noise(state, controls, cfg, extent, views, parts) if mcmc else None,
        owner=population.owner,
    )
    updated = updated._replace(
        value=lax.psum(updated.value, GAUSSIANS),
        finite=lax.pmin(updated.finite.astype(jnp.int32), GAUSSIANS) > 0,
    )
    if not mcmc:
        population = _observed(population, sums, healthy)
    moved = Moved(updated, MovedPoses(None, state.opt_state.poses, {}, None), population)
    return settled(
        state, moved, gradient, fits, most, rates, cfg=cfg, optimizer=optimizer, views=views
    )


def _sums(state, ids, visible, gradient, frusta, controls, cfg, bands: int, parts: int) -> Sums:
    """Return the sums over all views, one after the other and then over the groups."""
    gaussians, alive = state.params.gaussians, state.population.alive
    owner, n = state.population.owner, gaussians.capacity
    v_shown, in_image = to_gaussians((gradient.v_shown, gradient.visible), parts)

    def add(sums: Sums, view) -> tuple[Sums, None]:
        here, count, v_view, image, views = view
        size = block_size(here.shape[0])

        def body(k, sums: Sums) -> Sums:
            rows = slice_of(here, k, size)
            on = alive.at[rows].get(mode="fill", fill_value=False)
            mine = owners_at(owner, rows)

            def seen(block):
                degree = controls.active_degree
                return differentiable(splat(block, on, views, cfg.render, degree, mine))

            _, pull = jax.vjp(seen, take_rows(gaussians, rows, bands))
            v_block = slice_of(v_view, k, size)
            (v_rows,) = pull(v_block)
            half = jnp.stack([views[0].width / 2, views[0].height / 2])
            on_screen = v_block[0][0] * half
            pulled = slice_of(image, k, size) & (jnp.sum(jnp.abs(on_screen), -1) > 0)
            added = Sums(
                v_rows,
                jnp.ones(size, jnp.int32),
                jnp.linalg.norm(on_screen, axis=-1),
                pulled.astype(jnp.float32),
            )
            return jax.tree.map(
                lambda a, b: a.at[rows].add(b, mode="drop", unique_indices=True), sums, added
            )

        used = jnp.minimum(count, here.shape[0])
        return lax.fori_loop(0, -(-used // size), body, sums), None

    none = dataclasses.replace(gaussians, sh=gaussians.sh[:, :bands])
    blank = jax.tree.map(jnp.zeros_like, none)
    zeros = [jnp.zeros(n, kind) for kind in (jnp.int32, jnp.float32, jnp.float32)]
    given = (ids, visible[:, 0], v_shown, in_image, frusta)
    sums, _ = lax.scan(add, Sums(blank, *zeros), given)
    return lax.psum(sums, VIEWS)


def _noise(state, controls, cfg: FitConfig, extent: float, views: int, parts: int):
    """Return the noise of `update_listed`; each Gaussian's is its own, whatever device has it."""
    key = noise_key(controls.seed, state.step)
    rate = cfg.densify.noise * means_rate(controls.progress, controls.rate, extent, cfg)
    rate = rate * views**0.5
    first = lax.axis_index(GAUSSIANS)

    def noise(block, rows, moved, on):
        del block
        keys = jax.vmap(functools.partial(jax.random.fold_in, key))(rows * parts + first)
        normal = jax.vmap(lambda k: jax.random.normal(k, (3,)))(keys)
        return shaped_noise(normal, moved, on, rate)

    return noise


def _observed(population: Population, sums: Sums, healthy) -> Population:
    """Add the views to the densification statistics of what they show."""
    return dataclasses.replace(
        population,
        grad2d_sum=population.grad2d_sum + jnp.where(healthy, sums.grad2d, 0),
        seen_count=population.seen_count + jnp.where(healthy, sums.pulled, 0),
    )
