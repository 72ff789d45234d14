"""Steps of several views, divided over devices that each hold the whole scene.

Each device computes its views one by one, as in a step of one view; devices exchange only sums of
gradients. The loss is the mean over the views. The learning rates of one view are multiplied by the
root of the number of views, so that the same views move a Gaussian about as far (Krizhevsky 2014;
Grendel-GS, arXiv 2406.18533; docs/scaling.md).
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P
from jaxtyping import Float, Int

from p2gs_jax.config import FitConfig
from p2gs_jax.core.streams import noise_key
from p2gs_jax.errors import UserError
from p2gs_jax.gaussians.mcmc import exploration_noise
from p2gs_jax.render import visible as visibility
from p2gs_jax.render.harmonics import coefficient_count
from p2gs_jax.train import image_gradient
from p2gs_jax.train.divided import ALIKE, mesh_of_cores
from p2gs_jax.train.image_gradient import ImageGradient, Listed, differentiable
from p2gs_jax.train.optimizer import learning_rates, means_rate
from p2gs_jax.train.state import FitState
from p2gs_jax.train.step import MeshStep
from p2gs_jax.train.update import StepReport, finished, is_healthy, update_listed
from p2gs_jax.types import Array, Batch, Frustum, Gaussians

VIEWS = "views"
OF_VIEWS: Any = P(VIEWS)

Count = int | Literal["all"]


def default_mesh(count: int) -> Mesh:
    """Return a mesh of the first `count` devices."""
    return Mesh(np.array(jax.devices()[:count]), (VIEWS,))


def _counted(devices: Count) -> int:
    available = jax.device_count()
    if devices == "all":
        return available
    if not 1 <= devices <= available:
        why = f"--devices {devices} is not between 1 and {available}, the number of devices that "
        why += f"JAX sees here ({jax.default_backend()})."
        fix = "give a number in this range, or all; on a CPU, "
        fix += f"--threads {devices} makes {devices} devices from its cores"
        raise UserError(why, fix=fix)
    return devices


def with_a_view_each(cfg: FitConfig, devices: Count) -> FitConfig:
    """Return a configuration with one view per device, unless it sets a batch size already.

    UserError: JAX sees fewer devices.
    """
    count = _counted(devices)
    if count == 1 or cfg.train.batch > 1:
        return cfg
    return dataclasses.replace(cfg, train=dataclasses.replace(cfg.train, batch=count))


def mesh_of(cfg: FitConfig, devices: Count = 1) -> Mesh | None:
    """Return the mesh of a fit; None for steps of one view on one device.

    A batch is divided over devices by views; a single view is divided over the cores of a CPU.
    UserError: JAX sees fewer devices, or the batch is not a multiple of their number.
    """
    count, batch = _counted(devices), cfg.train.batch
    if batch == 1 and count == 1:
        return mesh_of_cores()
    if batch % count:
        why = f"--train.batch {batch} is not a multiple of the {count} devices."
        fix = f"give a multiple of {count}, such as --train.batch {-(-batch // count) * count}"
        raise UserError(why, fix=fix)
    return default_mesh(count)


# ------------------------------------------------- programs of one device, for its b views


def _show(gaussians, alive, frusta, active_degree, owner, **static) -> Listed:
    """List and project the Gaussians of each view; results are stacked, `visible` as [b, 1]."""

    def one(frustum):
        return image_gradient.show(gaussians, alive, frustum, active_degree, owner, **static)

    listed = lax.map(one, frusta)
    return listed._replace(visible=listed.visible[:, None])


def _differentiate(
    shown, photometry, appearance, batch, partner, *, views: int, **static
) -> ImageGradient:
    """Return the mean loss of all `views` of the step, and its gradient.

    The gradients by splats belong to the loss of each view of this device.
    """

    def one(view):
        splats, photograph, second = view
        return image_gradient.differentiate(
            splats, photometry, appearance, photograph, second, **static
        )

    each = lax.map(one, (shown, batch, partner))

    def mean(name):
        return jax.tree.map(lambda a: lax.psum(jnp.sum(a, 0), VIEWS) / views, getattr(each, name))

    return each._replace(
        **{name: mean(name) for name in ("loss", "terms", "v_rest", "psnr")},
        entries=lax.pmax(jnp.max(each.entries), VIEWS),
        overflow=lax.pmax(jnp.max(each.overflow.astype(jnp.int32)), VIEWS) > 0,
    )


class Sums(NamedTuple):
    """Sums over the views of a step."""

    gradient: Gaussians  # gradient of the sum of the views' losses
    shown: Int[Array, " n"]  # number of views that may show each Gaussian
    # sum of the norms of the gradients by position on the screen, in units of half the image
    grad2d: Float[Array, " n"]
    pulled: Float[Array, " n"]  # number of views in which this gradient is not zero


def _advance(
    state: FitState,
    ids: Int[Array, "b v"],
    visible: Int[Array, "b 1"],
    gradient: ImageGradient,
    frusta,
    controls,
    *,
    cfg: FitConfig,
    optimizer,
    extent: float,
    noise: float | None,
    degree: int,
    views: int,
) -> tuple[FitState, StepReport]:
    """Move all parameters by one step, equally on each device; see `update.advance`."""
    gaussians, population = state.params.gaussians, state.population
    alive, n, bands = population.alive, gaussians.capacity, coefficient_count(degree)
    most = lax.pmax(jnp.max(visible), VIEWS)
    fits = ~gradient.overflow & (most <= ids.shape[1])
    healthy = is_healthy(state, gradient, fits)
    sums = _sums(state, ids, visible, gradient, frusta, controls, cfg, bands)
    listed, count = visibility.compact((sums.shown > 0) & alive, visibility.whole_blocks(n))
    progress, rate = controls.progress, controls.rate
    rates = learning_rates(progress, rate, extent, state.params, cfg, bands)
    rates = jax.tree.map(lambda r: r * views**0.5, rates)
    noise_rate = (noise or 0.0) * means_rate(progress, rate, extent, cfg) * views**0.5
    key = noise_key(controls.seed, state.step)

    def exploring(block, rows, moved, on):
        # The key depends on the Gaussian, so the noise does not depend on the rest of the list.
        keys = jax.vmap(functools.partial(jax.random.fold_in, key))(rows)
        normal = jax.vmap(lambda k: jax.random.normal(k, (3,)))(keys)
        return exploration_noise(normal, moved, on, noise_rate)

    updated = update_listed(
        state,
        listed,
        count,
        healthy,
        bands=bands,
        # `sums` already holds the gradient by the Gaussians, so the function is the identity.
        inputs_of=lambda block, on, owner: block,
        v_inputs=jax.tree.map(
            lambda g: g / views, visibility.take_rows(sums.gradient, listed, bands)
        ),
        adam=optimizer.gaussians,
        rates=rates.gaussians,
        noise=None if noise is None else exploring,
    )
    if noise is None:
        population = dataclasses.replace(
            population,
            grad2d_sum=population.grad2d_sum + jnp.where(healthy, sums.grad2d, 0),
            seen_count=population.seen_count + jnp.where(healthy, sums.pulled, 0),
        )
    options = {"cfg": cfg, "optimizer": optimizer, "views": views}
    moved, checks = (updated, population), (fits, healthy, most)
    return finished(state, moved, gradient, checks, rates, **options)


def _sums(state, ids, visible, gradient, frusta, controls, cfg, bands: int) -> Sums:
    """Return the sums over all views: first over the views of a device, then over devices."""
    gaussians, alive = state.params.gaussians, state.population.alive
    owner, n = state.population.owner, gaussians.capacity

    def add(sums: Sums, view) -> tuple[Sums, None]:
        here, count, v_view, image, frustum = view
        size = visibility.block_size(here.shape[0])

        def body(k, sums: Sums) -> Sums:
            rows = visibility.slice_of(here, k, size)
            on = alive.at[rows].get(mode="fill", fill_value=False)
            owners = visibility.owners_at(owner, rows)

            def seen(block):
                degree = controls.active_degree
                return differentiable(
                    visibility.splat(block, on, frustum, cfg.render, degree, owners)
                )

            _, pull = jax.vjp(seen, visibility.take_rows(gaussians, rows, bands))
            v_block = visibility.slice_of(v_view, k, size)
            (v_rows,) = pull(v_block)
            half = jnp.stack([frustum.width / 2, frustum.height / 2])
            on_screen = v_block[0] * half
            pulled = visibility.slice_of(image, k, size) & (jnp.sum(jnp.abs(on_screen), -1) > 0)
            added = Sums(
                v_rows,
                jnp.ones(size, jnp.int32),
                jnp.linalg.norm(on_screen, axis=-1),
                pulled.astype(jnp.float32),
            )
            return jax.tree.map(
                lambda a, b: a.at[rows].add(b, mode="drop", unique_indices=True), sums, added
            )

        return visibility.over_blocks(body, count, here.shape[0], sums), None

    used = dataclasses.replace(gaussians, sh=gaussians.sh[:, :bands])
    blank = jax.tree.map(jnp.zeros_like, used)
    zeros = [jnp.zeros(n, kind) for kind in (jnp.int32, jnp.float32, jnp.float32)]
    views = (ids, visible[:, 0], gradient.v_shown, gradient.visible, frusta)
    sums, _ = lax.scan(add, Sums(blank, *zeros), views)
    return lax.psum(sums, VIEWS)


GRADIENT = ImageGradient(*(ALIKE for _ in ImageGradient._fields))
GRADIENT = GRADIENT._replace(v_shown=OF_VIEWS, visible=OF_VIEWS)


@dataclasses.dataclass(frozen=True, eq=False)
class ParallelStep(MeshStep):
    """The step of several views; `train.batch` is a multiple of the number of devices.

    Batches and partners are stacked; each device holds the whole state.
    """

    programs: ClassVar = {
        "show": (_show, (ALIKE, ALIKE, OF_VIEWS, ALIKE, ALIKE), OF_VIEWS),
        "differentiate": (_differentiate, (OF_VIEWS, ALIKE, ALIKE, OF_VIEWS, OF_VIEWS), GRADIENT),
        "advance": (_advance, (ALIKE, OF_VIEWS, OF_VIEWS, GRADIENT, OF_VIEWS, ALIKE), ALIKE),
    }

    def settings(self, name: str) -> dict[str, Any]:
        """Return the static arguments of one of the three programs, and the number of views."""
        views = {} if name == "show" else {"views": self.cfg.train.batch}
        return super().settings(name) | views

    def frustum(self, batch: Batch) -> Frustum:
        """Return the views of a step, stacked."""
        one, shape = super().frustum(batch), (self.cfg.train.batch,)
        width, height = (np.full(shape, size) for size in (one.width, one.height))
        return dataclasses.replace(one, width=width, height=height)

    def spread(self, state: FitState) -> FitState:
        """Return the state copied to each device."""
        return jax.device_put(jax.device_get(state), NamedSharding(self.mesh, ALIKE))

    def whole(self, state: FitState) -> FitState:
        """Return the state on the default device."""
        return jax.tree.map(jnp.asarray, jax.device_get(state))
