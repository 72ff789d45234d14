"""A check of the rasterizer on this device: image and gradient against float64.

Three scenes of one shape share one program: a crowd, needles, and radiance over 13 stops. A GPU
kernel is compiled by the libraries of its machine, which no test of this package covers.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import p2gs_jax.render as rendering
from p2gs_jax.config import RenderConfig
from p2gs_jax.core.numerics import on_host
from p2gs_jax.core.streams import Stream, generator
from p2gs_jax.render.binning import grid_size
from p2gs_jax.render.tiles import slow_here
from p2gs_jax.render.xla_cpu import compiler_options
from p2gs_jax.types import Camera, Gaussians

WIDTH, HEIGHT, COUNT = 32, 24, 64  # pixels, pixels, Gaussians
# Largest allowed errors: of the image relative to its brightest value, of gradients in the relative
# L2 norm. The stop rule causes 5e-4 and 5e-3; a wrong kernel has far larger errors.
IMAGE, GRADIENT = 1e-3, 1e-2


class SelfCheck(NamedTuple):
    """The largest errors over the scenes; not finite if a value is not."""

    image: float
    gradient: float

    @property
    def fault(self) -> str | None:
        """A phrase that names the error; None without an error."""
        if not self.image <= IMAGE:
            return f"the image is wrong by {self.image:.0e} of its brightest value"
        if not self.gradient <= GRADIENT:
            return f"the gradient is wrong by {self.gradient:.0e}"
        return None


def scenes() -> Iterator[Gaussians]:
    """Yield Gaussians that are hard for a rasterizer, in camera coordinates; float64."""
    rng = generator(0, Stream.SELF_CHECK)
    for needle, stops in ((1.0, 2.0), (5.0, 2.0), (1.0, 13.0)):
        z = rng.uniform(2, 9, COUNT)
        aside = rng.uniform(-0.6, 0.6, (COUNT, 2)) * z[:, None]
        scales = np.log(0.06 * z)[:, None] + rng.normal(0, 0.4, (COUNT, 3))
        scales[:, 0] += needle
        light = np.log(2) * stops * rng.uniform(-0.5, 0.5, (COUNT, 1, 3))
        quats, logits = rng.normal(size=(COUNT, 4)), rng.normal(0, 2, COUNT)
        yield on_host(Gaussians, np.c_[aside, z], quats, scales, logits, light)


def _checked(gaussians: Gaussians, kind: np.dtype, cfg: RenderConfig):
    """Return the gradient of a weighted sum of the image, and the image, in the type `kind`."""
    gaussians = jax.tree.map(lambda a: jnp.asarray(a, kind), gaussians)
    K = np.array([[WIDTH, 0, WIDTH / 2], [0, WIDTH, HEIGHT / 2], [0, 0, 1]])
    camera = Camera(jnp.eye(4, dtype=kind), jnp.asarray(K, kind), WIDTH, HEIGHT)
    weights = jnp.asarray(generator(1, Stream.SELF_CHECK).normal(size=(HEIGHT, WIDTH, 3)), kind)
    alive, tiles = jnp.ones(COUNT, bool), math.prod(grid_size(WIDTH, HEIGHT, cfg.tile))

    def loss(g):
        image = rendering.render_linear(g, alive, camera, cfg, COUNT * tiles).linear
        return jnp.sum(weights * image), image

    return jax.grad(loss, has_aux=True)(gaussians)


def self_check(cfg: RenderConfig | None = None) -> SelfCheck:
    """Compare the rasterizer of `cfg` with the float64 reference; compilation takes seconds."""
    cfg = RenderConfig() if cfg is None else cfg
    exact_cfg = dataclasses.replace(cfg, implementation="reference")
    options = compiler_options()
    tested = jax.jit(lambda g: _checked(g, np.dtype(np.float32), cfg), compiler_options=options)
    reference = jax.jit(lambda g: _checked(g, np.dtype(np.float64), exact_cfg))
    image_errors, gradient_errors = [], []
    for scene in scenes():
        gradient, image = jax.tree.map(np.asarray, tested(scene))
        with jax.enable_x64(True):
            exact = reference(scene)
        true_gradient, true_image = jax.tree.map(np.asarray, exact)
        image_errors.append(np.abs(image - true_image).max() / true_image.max())
        for a, b in zip(*map(jax.tree.leaves, (gradient, true_gradient)), strict=True):
            gradient_errors.append(np.linalg.norm(a - b) / np.linalg.norm(b))
    return SelfCheck(float(np.max(image_errors)), float(np.max(gradient_errors)))


def suited(render: RenderConfig) -> tuple[RenderConfig, str | None]:
    """Return options with a rasterizer for this device, and a note for the user or None.

    A chosen rasterizer stays. The default of a GPU with kernels is checked first, because its card,
    driver and compiler are untested; after a fault, `xla` replaces it.
    """
    if render.implementation is not None or jax.default_backend() == "cpu":
        return render, None
    slow = slow_here()
    if slow is not None:
        return render, slow
    try:
        fault = self_check(render).fault
    except Exception as error:  # compilers raise many types
        fault = f"{type(error).__name__}: {error}"
    if fault is None:
        return render, None
    note = (
        f"The rasterizer for GPUs failed its self-check on this device ({fault}): the portable one "
        "is used, which is much slower. Please report this with the output of `p2gs-jax doctor`."
    )
    return dataclasses.replace(render, implementation="xla"), note
