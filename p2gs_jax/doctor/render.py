"""The devices and the rasterizer that a fit would use, and a self-test with three Gaussians."""

from __future__ import annotations

import time
from dataclasses import dataclass

# Two float32 implementations of one image, brightest value about 1.
TOLERANCE = 1e-4


@dataclass(frozen=True)
class Devices:
    """Devices of JAX.

    Attributes:
        backend: `cpu`, `gpu` or another of JAX's; None where it does not start.
        names: of the devices, with their memory where known.
        rasterizer: implementation of compositing.
        binning: implementation of the tile lists.
        trouble: why JAX does not start, or None.
    """

    backend: str | None
    names: list[str]
    rasterizer: str | None
    binning: str | None
    trouble: str | None


@dataclass(frozen=True)
class SelfTest:
    """Result of rendering three Gaussians.

    Attributes:
        ok: whether image and gradients are right; None where it was not run.
        remark: in words.
        first_ms: the first time, with compilation.
        then_ms: once compiled.
        difference: largest difference from the reference implementation.
    """

    ok: bool | None
    remark: str
    first_ms: float | None = None
    then_ms: float | None = None
    difference: float | None = None


def inspect_devices() -> Devices:
    """Return the devices and the implementations that a fit would use; never raises."""
    try:
        import jax

        backend = jax.default_backend()
        names = [f"{d.device_kind}{_memory(d)}" for d in jax.devices()]
        from p2gs_jax.render import fastest_here

        rasterizer = fastest_here()
    except Exception as error:  # whatever a broken JAX raises
        return Devices(None, [], None, None, f"{type(error).__name__}: {error}")
    # As `render.binning` chooses where the configuration says None.
    binning = "counting" if backend == "cpu" else "sorting"
    return Devices(backend, names, rasterizer, binning, None)


def self_test() -> SelfTest:
    """Render three Gaussians and take gradients; never raises."""
    try:
        return _self_test()
    except Exception as error:  # whatever is broken
        return SelfTest(False, f"{type(error).__name__}: {error}")


def _self_test() -> SelfTest:
    import dataclasses

    import jax
    import jax.numpy as jnp
    import numpy as np

    from p2gs_jax.config import RenderConfig
    from p2gs_jax.render import render_linear
    from p2gs_jax.render.xla_cpu import compiler_options
    from p2gs_jax.types import Camera, Gaussians

    gaussians = Gaussians(
        means=jnp.array([[-0.5, 0.0, 3.0], [0.0, 0.2, 4.0], [0.6, -0.1, 5.0]]),
        quats=jnp.array([[1.0, 0.0, 0.0, 0.0], [0.9, 0.1, 0.3, 0.0], [0.7, 0.0, 0.0, 0.7]]),
        log_scales=jnp.log(jnp.array([[0.3, 0.2, 0.2], [0.5, 0.1, 0.2], [0.4, 0.4, 0.1]])),
        opacity_logits=jnp.array([1.0, 2.0, 0.5]),
        sh=jnp.array([[[0.2, -0.5, -1.0]], [[-1.0, 0.3, -0.5]], [[-0.5, -1.0, 0.4]]]),
    )
    K = jnp.array([[24.0, 0.0, 16.0], [0.0, 24.0, 12.0], [0.0, 0.0, 1.0]])
    camera, cfg = Camera(jnp.eye(4), K, 32, 24), RenderConfig()
    alive = jnp.ones(3, bool)

    def loss(g, cfg):
        image = render_linear(g, alive, camera, cfg, 4096).linear
        return jnp.sum(image**2), image

    step = jax.jit(
        jax.value_and_grad(loss, has_aux=True),
        static_argnums=1,
        compiler_options=compiler_options(),
    )

    def timed():
        begin = time.monotonic()
        (_, image), gradient = jax.block_until_ready(step(gaussians, cfg))
        return 1e3 * (time.monotonic() - begin), image, gradient

    first, image, gradient = timed()
    then = min(timed()[0] for _ in range(5))
    truth = loss(gaussians, dataclasses.replace(cfg, implementation="reference"))[1]
    difference = float(jnp.max(jnp.abs(image - truth)))
    flat = np.concatenate([np.ravel(a) for a in jax.tree.leaves(gradient)])
    if not np.isfinite(flat).all() or not flat.any():
        return SelfTest(False, "the gradients are wrong", first, then, difference)
    if not difference < TOLERANCE:
        return SelfTest(False, "the image is wrong", first, then, difference)
    return SelfTest(True, "three Gaussians and their gradients", first, then, difference)


def _memory(device) -> str:
    try:
        limit = (device.memory_stats() or {}).get("bytes_limit")
    except Exception:  # CPUs and some plugins do not tell
        limit = None
    return f" ({limit / 2**30:.1f} GiB)" if limit else ""
