"""Properties of the GPU kernels alone; their values and gradients: test_rasterize.py."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import pytest
from scenes import camera, street

from p2gs_jax.config import RenderConfig
from p2gs_jax.render import rasterize_pallas, render_linear
from p2gs_jax.render.tiles import fastest_here, slow_here

CFG = RenderConfig(implementation="pallas", binning="sorting")
CAPACITY = 8000


def loss(g, cam, cfg):
    r = render_linear(g, jnp.ones(g.capacity, bool), cam, cfg, CAPACITY)
    return jnp.sum(r.linear**2) + jnp.sum(r.alpha) + 0.01 * jnp.sum(r.depth)


@pytest.mark.slow
def test_views_can_be_batched_and_ordered_sums_agree_with_atomic_ones():
    g, cam = street(n=60, width=24, height=16)
    ordered = dataclasses.replace(CFG, deterministic=True)
    viewmats = jnp.stack([jnp.eye(4).at[0, 3].set(0.3 * i) for i in range(3)])

    def view(g, viewmat, cfg=CFG):
        return loss(g, dataclasses.replace(cam, viewmat=viewmat), cfg)

    batch = jax.value_and_grad(
        lambda g: jnp.sum(jax.vmap(functools.partial(view, cfg=ordered), (None, 0))(g, viewmats))
    )
    single = jax.jit(jax.value_and_grad(view))
    a, v_a = jax.jit(batch)(g)
    b, v_b = jax.tree.map(lambda *views: sum(views), *(single(g, v) for v in viewmats))
    assert float(a) == pytest.approx(float(b), rel=1e-5)
    gaps = jax.tree.map(lambda x, y: jnp.linalg.norm(x - y) / jnp.linalg.norm(x), v_a, v_b)
    assert max(float(x) for x in jax.tree.leaves(gaps)) < 1e-5


@pytest.mark.skipif(
    jax.__version_info__ >= (0, 11) and jax.default_backend() != "gpu",
    reason="from JAX 0.11 on Pallas lowers only for a GPU that is there",
)
@pytest.mark.parametrize(
    ("size", "deterministic", "kernels"),
    [
        # Images of many tiles.
        ((256, 256), False, ["composite_tiles", "composite_tiles_gradient"]),
        ((256, 256), True, ["composite_tiles", "composite_tiles_gradient", "sum_gradients"]),
        # The lists of few tiles are cut into segments.
        ((40, 32), False, ["composite_tiles", "merge_segments", "composite_tiles_gradient"]),
    ],
)
def test_the_kernels_lower_to_triton(monkeypatch, size, deterministic, kernels):
    """Without a GPU the program for one can still be lowered."""
    monkeypatch.setattr(rasterize_pallas, "_interpreted", lambda: False)
    g, cam = street(n=200, width=size[0], height=size[1])
    cfg = dataclasses.replace(CFG, deterministic=deterministic)
    traced = jax.jit(jax.grad(lambda g: loss(g, cam, cfg))).trace(g)
    text = traced.lower(lowering_platforms=("cuda",)).as_text()
    assert text.count("__gpu$xla.gpu.triton") == len(kernels)
    assert all(name in text for name in kernels)


def test_the_fastest_supported_implementation_is_chosen(monkeypatch):
    assert fastest_here() == ("pallas" if jax.default_backend() == "gpu" else "xla")
    assert slow_here() is None or jax.default_backend() != "cpu"

    class Device:
        compute_capability, device_kind = "9.0", "Card"

    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(jax, "devices", lambda: [Device()])
    assert fastest_here() == "pallas"
    assert slow_here() is None
    for other in ("7.5", "gfx90a:sramecc+", None):
        if other is None:
            del Device.compute_capability
        else:
            Device.compute_capability = other
        assert fastest_here() == "xla"
        assert slow_here().startswith("Card is not an NVIDIA GPU of compute capability 8.0")


def test_sizes_of_tiles_must_be_powers_of_two():
    cfg = dataclasses.replace(CFG, tile=(12, 8))
    with pytest.raises(ValueError, match="power of two"):
        jax.eval_shape(lambda g: loss(g, camera(), cfg), street(n=3)[0])
