"""Scenes that break rasterizers: their expected behaviour, and float32's error against float64."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.oracle import FIELDS
from p2gs_jax.config import RenderConfig
from p2gs_jax.render import project, render_linear
from p2gs_jax.render.binning_cpu import grid_size
from p2gs_jax.render.harmonics import C0
from p2gs_jax.render.project import view_radiance
from p2gs_jax.types import Camera, Gaussians, Splats2D

# A near plane that float32 represents exactly, so that "on the plane" means the same in float64.
NEAR = 0.0625
CONFIG = RenderConfig(near=NEAR, pixels_in_flight=1024)
# Scenes are padded to a multiple of this, so that they share their compiled programs.
PADDING = 512
# A pair whose exponent is this close to the cutoff may be on either side of it.
UNDECIDED = 2e-4
SMALL_GROUP = 1e-4


def camera(width: int = 37, height: int = 21, focal: float = 30.0) -> Camera:
    """Return a camera at the origin that looks along z."""
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], np.float32)
    return Camera(jnp.eye(4), jnp.asarray(K), width, height)


def splats(
    n: int = 1,
    *,
    mean=(0.1, -0.05, 4.0),
    quat=(0.9, 0.1, -0.3, 0.2),
    scales=(0.5, 0.3, 0.2),
    logit=1.0,
    radiance=(0.7, 0.4, 0.2),
) -> Gaussians:
    """Return `n` Gaussians; each argument is one value for all, or an array of `n` values."""

    def rows(value, width):
        return np.broadcast_to(np.asarray(value, np.float64), (n, width) if width else (n,))

    sh = np.log(np.maximum(rows(radiance, 3), 1e-35))[:, None] / C0
    leaves = (rows(mean, 3), rows(quat, 4), np.log(rows(scales, 3)), rows(logit, 0), sh)
    return Gaussians(*(jnp.asarray(a, jnp.float32) for a in leaves))


def crowd(n: int = 60, seed: int = 0, **overrides) -> Gaussians:
    """Return random overlapping Gaussians; `overrides` replace arguments of `splats`."""
    rng = np.random.default_rng(seed)
    values = {
        "mean": np.stack([*rng.uniform(-2, 2, (2, n)), rng.uniform(2, 8, n)], -1),
        "quat": rng.normal(size=(n, 4)),
        "scales": np.exp(rng.normal(-1.3, 0.5, (n, 3))),
        "logit": rng.normal(0, 1.5, n),
        "radiance": np.exp(rng.normal(-1, 1, (n, 3))),
    }
    return splats(n, **(values | overrides))


# The image size is not divisible by the tile size.
VIEW = camera()


@dataclass(frozen=True)
class HardCase:
    """One scene and its expected behaviour.

    Attributes:
        name: name in tables.
        expect: the expected behaviour, in words.
        build: returns the scene.
        view: the camera.
        value_tolerance: largest image error relative to the largest value, without undecided
            pairs and the stop rule.
        gradient_tolerance: largest relative L2 error of any gradient group.
        unseen: whether the image must be empty and every gradient exactly zero.
    """

    name: str
    expect: str
    build: Callable[[], Gaussians]
    view: Camera = VIEW
    value_tolerance: float = 2e-5
    gradient_tolerance: float = 5e-4
    unseen: bool = False


def _bright_and_dark() -> Gaussians:
    rng = np.random.default_rng(3)
    level = np.where(np.arange(48) % 2, 1e4, 1.0)[:, None]
    return crowd(48, 3, radiance=level * rng.uniform(0.5, 1, (48, 3)), logit=rng.normal(2, 2, 48))


CASES = (
    HardCase("zero quaternion", "is the identity", lambda: splats(quat=(0, 0, 0, 0))),
    HardCase(
        "unnormalised quaternions",
        "only their direction matters",
        lambda: crowd(
            quat=np.random.default_rng(1).normal(size=(60, 4)) * np.logspace(-6, 6, 60)[:, None]
        ),
    ),
    HardCase(
        "huge quaternions",
        "no overflow up to 1e30",
        lambda: splats(2, quat=[[1e30, 2e30, 0, 1e29], [1e-25, 0, 2e-25, 0]]),
    ),
    HardCase(
        "needle 1e3 x 1e-7 m",
        "positive determinant, finite, right",
        lambda: splats(scales=(1e3, 1e-7, 1e-7)),
        value_tolerance=5e-4,
        gradient_tolerance=2e-2,
    ),
    HardCase(
        "disc 1e3 x 1e3 x 1e-7 m",
        "covers the view without overflow",
        lambda: splats(scales=(1e3, 1e3, 1e-7), quat=(1, 0, 0, 0)),
    ),
    HardCase("speck 1e-7 m", "the blur keeps it visible", lambda: splats(scales=(1e-7,) * 3)),
    HardCase("opacity 0", "nothing, zero gradient", lambda: splats(logit=-80.0), unseen=True),
    HardCase(
        "opacity 1 - 1e-7",
        "clamped at alpha_max, finite gradients",
        lambda: crowd(logit=np.where(np.arange(60) % 3, 0.0, 16.1)),
    ),
    HardCase("radiance 0", "black but opaque", lambda: splats(radiance=0.0)),
    HardCase("radiance 1e-8", "keeps its relative precision", lambda: splats(radiance=1e-8)),
    HardCase("radiance 1e6", "keeps its relative precision", lambda: splats(radiance=1e6)),
    HardCase("radiance 10^4:1 in one tile", "relative error below 1e-3", _bright_and_dark),
    HardCase("behind the camera", "nothing", lambda: splats(mean=(0, 0, -3.0)), unseen=True),
    HardCase("on the near plane", "nothing", lambda: splats(mean=(0, 0, NEAR)), unseen=True),
    HardCase(
        "just before the near plane",
        "nothing",
        lambda: splats(mean=(0, 0, NEAR * (1 - 1e-6))),
        unseen=True,
    ),
    HardCase(
        "just beyond the near plane",
        "covers the view, finite",
        lambda: splats(mean=(0.01, 0, NEAR * (1 + 1e-5))),
        value_tolerance=1e-4,
        gradient_tolerance=5e-3,
    ),
    HardCase(
        "centre on the image border",
        "its inner half appears",
        lambda: splats(mean=(-2.5, 0.0, 4.0)),
    ),
    HardCase(
        "centre far outside, reaching in",
        "its flank appears",
        lambda: splats(mean=(-6.0, 0.0, 4.0), scales=(3.0, 0.5, 0.5), quat=(1, 0, 0, 0)),
        value_tolerance=1e-4,
    ),
    HardCase("far outside", "nothing", lambda: splats(mean=(1e4, 0, 1.0)), unseen=True),
    HardCase(
        "covers the whole image", "one value nearly everywhere", lambda: splats(scales=(60.0,) * 3)
    ),
    HardCase(
        "smaller than a pixel",
        "blurred to its share",
        lambda: crowd(scales=1e-4),
    ),
    HardCase(
        "depth ties",
        "the lower index is in front",
        lambda: crowd(
            mean=np.concatenate(
                [np.random.default_rng(5).uniform(-1.5, 1.5, (60, 2)), np.full((60, 1), 4.0)], 1
            )
        ),
    ),
    HardCase("identical Gaussians", "as one after another", lambda: splats(7)),
    HardCase(
        "10^5 Gaussians in one tile",
        "nothing dropped",
        lambda: crowd(100_000, 2, scales=0.05, logit=-4.0),
        camera(16, 8, 4.0),
        value_tolerance=2e-4,
        gradient_tolerance=5e-3,
    ),
    HardCase(
        "empty tiles",
        "black, transmittance 1",
        lambda: splats(mean=(-1.8, -1.0, 4.0), scales=(0.05,) * 3),
    ),
    HardCase("1 x 1 pixel", "one right pixel", crowd, camera(1, 1, 2.0)),
)


class Gap(NamedTuple):
    """Differences between an implementation and the float64 oracle.

    Attributes:
        value: largest image error beyond undecided pairs, relative to the largest value.
        relative: largest relative error of a pixel; pixels darker than 1e-4 of the largest value
            are measured relative to that level.
        gradient: largest relative L2 error of a gradient group; groups smaller than `SMALL_GROUP`
            of the largest (cancellation, as along a needle) are measured relative to that level.
        undecided: number of pairs so near the cutoff that float32 may be on either side.
        finite: whether all values and gradients are finite.
        silent: whether the image is empty and every gradient exactly zero.
    """

    value: float
    relative: float
    gradient: float
    undecided: int
    finite: bool
    silent: bool


def _weights(view: Camera):
    rng = np.random.default_rng(0)
    shape = (view.height, view.width)
    return rng.normal(size=(*shape, 3)), rng.normal(size=shape), 0.05 * rng.normal(size=shape)


@functools.partial(jax.jit, static_argnames=("cfg", "capacity"))
def _value_and_gradient(gaussians, alive, view, weights, cfg, capacity):
    def objective(g):
        r = render_linear(g, alive, view, cfg, capacity)
        a, b, c = weights
        return jnp.sum(r.linear * a) + jnp.sum(r.alpha * b) + jnp.sum(r.depth * c), r

    return jax.grad(objective, has_aux=True)(gaussians)


def _padded(gaussians: Gaussians):
    """Return the Gaussians padded to a multiple of PADDING, and flags of the live ones."""
    n = gaussians.capacity
    padding = -n % PADDING
    # NumPy pads, because JAX would compile a program for every shape.
    padded = jax.tree.map(
        lambda a: np.pad(np.asarray(a), [(0, padding)] + [(0, 0)] * (np.ndim(a) - 1)), gaussians
    )
    return jax.device_put(padded), jax.device_put(np.arange(n + padding) < n)


def _evaluate(gaussians: Gaussians, view: Camera, cfg: RenderConfig):
    padded, alive = _padded(gaussians)
    across, down = grid_size(view.width, view.height, cfg.tile)
    weights = tuple(jnp.asarray(w, gaussians.means.dtype) for w in _weights(view))
    gradient, result = _value_and_gradient(
        padded, alive, view, weights, cfg, across * down * padded.capacity
    )
    gradient = jax.tree.map(lambda a: np.asarray(a)[: gaussians.capacity], gradient)
    return jax.tree.map(np.asarray, result), gradient


@functools.partial(jax.jit, static_argnames="cfg")
def _splats(gaussians, alive, view, cfg):
    brightest = jnp.max(view_radiance(gaussians, view, cfg), where=alive[:, None], initial=0.0)
    return project(gaussians, alive, view, cfg), brightest


def _undecided(s: Splats2D, view: Camera, cfg: RenderConfig) -> np.ndarray:
    """Return the number of undecided splats per pixel: too close to the cutoff for float32."""
    x = np.arange(view.width) + 0.5
    y = np.arange(view.height) + 0.5
    counts = np.zeros((view.height, view.width), int)
    cutoff = np.log(cfg.alpha_cutoff)
    arrays = (s.means2d, s.conic_factor, s.log_opacities, s.visible)
    for m, f, o, visible in zip(*map(np.asarray, arrays), strict=True):
        if visible:
            dx, dy = x[None] - m[0], y[:, None] - m[1]
            e = o - 0.5 * ((f[0] * dx + f[1] * dy) ** 2 + (f[2] * dy) ** 2)
            counts += np.abs(e - cutoff) < UNDECIDED
    return counts


def float64_oracle(gaussians: Gaussians, view: Camera, cfg: RenderConfig):
    """Return (render, gradients, undecided pairs, largest radiance) in float64."""
    with jax.enable_x64(True):
        g64, view64 = jax.tree.map(lambda a: jnp.asarray(a, jnp.float64), (gaussians, view))
        exact = dataclasses.replace(cfg, implementation="reference")
        result, gradient = _evaluate(g64, view64, exact)
        splats, brightest = _splats(*_padded(g64), view64, exact)
    return result, gradient, _undecided(splats, view, cfg), float(brightest)


def gap(case: HardCase, cfg: RenderConfig, oracle=None) -> Gap:
    """Compare one implementation with the float64 oracle on one case.

    `oracle` is a result of `float64_oracle` that several implementations share, or None.
    """
    g = case.build()
    truth, v_truth, undecided, brightest = oracle or float64_oracle(g, case.view, cfg)
    result, gradient = _evaluate(g, case.view, cfg)
    assert not result.overflow
    allowed = undecided * cfg.alpha_cutoff
    error = np.abs(result.linear - truth.linear)
    largest = max(truth.linear.max(), 1e-30)
    beyond = np.maximum(error - (allowed * brightest)[..., None], 0)
    brightest_channel = np.maximum(truth.linear.max(-1), 1e-4 * largest)
    value = max(
        beyond.max() / largest,
        float(np.maximum(np.abs(result.alpha - truth.alpha) - allowed, 0).max()),
    )
    pairs = [(getattr(gradient, k), getattr(v_truth, k)) for k in FIELDS]
    floor = max(1e-12, SMALL_GROUP * max(float(np.linalg.norm(b)) for _, b in pairs))
    errors = [np.linalg.norm(a - b) / max(np.linalg.norm(b), floor) for a, b in pairs]
    leaves = [*jax.tree.leaves(gradient), result.linear, result.alpha, result.depth]
    return Gap(
        value=float(value),
        relative=float((beyond.max(-1) / brightest_channel).max()),
        gradient=float(max(errors, default=0.0)),
        undecided=int(undecided.sum()),
        finite=all(bool(np.all(np.isfinite(a))) for a in leaves),
        silent=not any(np.any(a) for a in leaves),
    )
