"""Display colours for ordinary 3DGS viewers, their conversion to radiance, and both errors.

A viewer composites display values; the true picture composites radiance and then applies the tone
curve. So display colours computed per Gaussian are wrong by many 8-bit levels where translucent
Gaussians overlap (BUILD_NOTES, "Display PLY"). `refine` optimises colours and opacities. The same
holds for display colours of other programs that are lifted to radiance.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, UInt8

from p2gs_jax.config import RenderConfig
from p2gs_jax.core.numerics import fibonacci_sphere, on_device
from p2gs_jax.photometry.display import DisplayTransform, develop, undevelop
from p2gs_jax.photometry.formation import formation
from p2gs_jax.render import harmonics, render_linear
from p2gs_jax.render.capacity import (
    PICTURES,
    RenderView,
    bucket,
    count_needed,
    make_renderer,
    until_it_fits,
)
from p2gs_jax.render.harmonics import C0, RadianceKind, degree_of
from p2gs_jax.render.xla_cpu import compiler_options
from p2gs_jax.types import Camera, Gaussians, Render

DIRECTIONS = 64  # number of directions of the least squares
# Gaussians per chunk; the last chunk is padded, so that all chunks share one program.
CHUNK = 8192
# Variance that viewers add to the 2D covariance, as 3DGS does, pixels^2.
VIEWER_BLUR = 0.3
# Adam's learning rates for colours of degree 0, of higher degrees, and for opacity logits. They
# decay to 0.1 times these values. They were chosen on two runs (BUILD_NOTES, "Display PLY").
COLOR_RATE, BANDS_RATE, OPACITY_RATE, DECAY = 0.05, 0.0025, 0.3, 0.1


@dataclass(frozen=True)
class Target:
    """A view and its true picture, 8-bit."""

    name: str
    camera: Camera
    picture: UInt8[np.ndarray, "h w 3"]


def target(
    name: str,
    gaussians: Gaussians,
    camera: Camera,
    render: RenderView,
    transform: DisplayTransform | None = None,
) -> Target:
    """Return a view with its true picture: linear radiance is composited, then developed.

    Without a `transform` it is the picture of a viewer (`viewer_config`) of display colours.
    """
    linear = np.asarray(render(gaussians, gaussians.all_alive, camera).linear)
    display = np.clip(linear, 0, 1) if transform is None else develop(linear, transform)
    return Target(name, camera, np.rint(255 * display).astype(np.uint8))


def display_comments(transform: DisplayTransform) -> list[str]:
    """Return the header lines of a PLY with display colours."""
    lines = [
        "p2gs-jax: display colours, tone-mapped",
        f"p2gs-jax: exposure {transform.exposure:.6g}, gamma {transform.gamma:.6g}, "
        f"curve {transform.formation.curve}",
    ]
    if transform.white_balance is not None:
        factors = ", ".join(f"{w:.6g}" for w in np.exp(transform.white_balance))
        lines.append(f"p2gs-jax: white balance {factors}")
    return lines


def bake(gaussians: Gaussians, transform: DisplayTransform, activation: RadianceKind) -> Gaussians:
    """Return linear Gaussians with display colours, computed per Gaussian."""
    sh = np.asarray(gaussians.sh)
    display = display_sh(sh, lambda linear: develop(linear, transform), activation)
    return replace(gaussians, sh=on_device(display))


def display_sh(
    sh: Float[np.ndarray, "n k 3"],
    tone: Callable[[np.ndarray], np.ndarray],
    activation: RadianceKind,
) -> Float[np.ndarray, "n k 3"]:
    """Return coefficients whose value + 1/2 is the display colour: least squares over directions.

    It is exact for degree 0. `tone` maps radiance to display values, which are then clamped to
    [0, 1].
    """

    def display(sums: np.ndarray) -> np.ndarray:
        colors = tone(np.asarray(harmonics.radiance_activation(sums, activation)))
        return np.clip(colors, 0, 1) - 0.5

    return refitted(sh, display)


def lift(gaussians: Gaussians, developed: DisplayTransform) -> Gaussians:
    """Return Gaussians of display colours with log radiance (`exp`), computed per Gaussian.

    `developed` is the transform that made the display colours. Colours outside of [0, 1] are
    clamped, and black counts as half an 8-bit code.
    """

    def logs(sums: np.ndarray) -> np.ndarray:
        return np.log(undevelop(np.clip(sums + 0.5, 0, 1), developed))

    return replace(gaussians, sh=on_device(refitted(np.asarray(gaussians.sh), logs)))


def refitted(
    sh: Float[np.ndarray, "n k 3"], change: Callable[[np.ndarray], np.ndarray]
) -> Float[np.ndarray, "n k 3"]:
    """Return coefficients whose sums are `change` of the old sums: least squares over directions.

    It is exact for degree 0.
    """
    directions = fibonacci_sphere(DIRECTIONS)
    table = harmonics.table(directions, degree_of(sh.shape[1]))
    inverse = np.linalg.pinv(table)
    out = np.empty(sh.shape, np.float32)
    for start in range(0, len(sh), CHUNK):
        part = sh[start : start + CHUNK]
        values = np.zeros((CHUNK, DIRECTIONS, 3), np.float32)
        values[: len(part)] = np.einsum("dk,nkc->ndc", table, part, optimize=True)
        values = change(values)[: len(part)]
        out[start : start + CHUNK] = np.einsum("kd,ndc->nkc", inverse, values, optimize=True)
    return out


def viewer_config(cfg: RenderConfig) -> RenderConfig:
    """Return the options of an ordinary 3DGS viewer: display colours max(0, sh + 1/2)."""
    return replace(cfg, radiance="linear", blur=VIEWER_BLUR, background=None)


def refine(
    gaussians: Gaussians,
    targets: Sequence[Target],
    cfg: RenderConfig,
    *,
    steps: int,
    seed: int = 0,
    shown: DisplayTransform | None = None,
    on_step: Callable[[int, int], None] = lambda done, steps: None,
) -> Gaussians:
    """Return Gaussians from `bake` whose pictures in a viewer are closer to the targets.

    Adam minimises the mean squared difference, one view per step, in epochs of random order. Every
    second step has a background of random colour instead of black, because viewers may have bright
    backgrounds. Base colours stay in [0, 1], which viewers with 8-bit colours need. With `shown`,
    the Gaussians come from `lift`, and their radiance over black is developed. Gaussians that no
    target shows do not change. `on_step` is called with the steps done and the total.
    """
    if steps == 0 or not targets or gaussians.capacity == 0:
        return gaussians
    cfg, optimizer = cfg if shown else viewer_config(cfg), optax.scale_by_adam(eps=1e-15)
    alive = gaussians.all_alive
    needed = max(int(count_needed(gaussians, alive, t.camera, cfg=cfg)) for t in targets)
    capacity = bucket(needed, PICTURES)
    bands = jnp.full((gaussians.sh.shape[1], 1), BANDS_RATE).at[0].set(COLOR_RATE)
    rates = {"sh": bands, "opacity_logits": OPACITY_RATE}

    # Defined here, so that means and scales are constants, which XLA folds.
    @functools.partial(jax.jit, static_argnames="capacity", compiler_options=compiler_options())
    def step(trained, state, camera, picture, background, decay, *, capacity):
        def loss(trained):
            current = replace(gaussians, **trained)
            result = render_linear(current, alive, camera, cfg, capacity, with_depth=False)
            display = _over(result, background)
            if shown is not None:
                display = formation(display, shown.capture, shown.formation)
            return jnp.mean((display - picture / 255.0) ** 2), result

        (_, result), gradient = jax.value_and_grad(loss, has_aux=True)(trained)
        updates, state = optimizer.update(gradient, state)
        updated = jax.tree.map(lambda v, rate, u: v - decay * rate * u, trained, rates, updates)
        if shown is None:
            base = jnp.clip(updated["sh"][:, 0], -0.5 / C0, 0.5 / C0)
            updated["sh"] = updated["sh"].at[:, 0].set(base)
        return (updated, state), result.count, result.overflow

    rng, order = np.random.default_rng(seed), []
    trained = {"sh": gaussians.sh, "opacity_logits": gaussians.opacity_logits}
    state = optimizer.init(trained)
    for done in range(steps):
        order = order or list(rng.permutation(len(targets)))
        view = targets[order.pop()]
        decay = jnp.float32(DECAY ** (done / steps))
        picture = jnp.asarray(view.picture)
        bright = done % 2 if shown is None else 0
        background = jnp.asarray(rng.uniform(size=3) * bright, jnp.float32)
        inputs = (trained, state, view.camera, picture, background, decay)
        (trained, state), capacity = until_it_fits(
            lambda entries, inputs=inputs: step(*inputs, capacity=entries), capacity
        )
        on_step(done + 1, steps)
    return replace(gaussians, **trained)


def baking_error(
    gaussians: Gaussians,
    targets: Sequence[Target],
    cfg: RenderConfig,
    shown: DisplayTransform | None = None,
) -> dict[str, Any] | None:
    """Compare a viewer's pictures of display colours with the true pictures.

    With `shown`, the viewer develops the radiance of lifted Gaussians, and the true pictures
    composite display colours.
    PSNR is in dB, for a black and for a white background of the viewer. Mean and largest absolute
    differences of channels are in 8-bit levels. The result is None without targets.
    """
    if not targets:
        return None
    render = make_renderer(viewer_config(cfg) if shown is None else cfg)
    render = functools.partial(render, gaussians, gaussians.all_alive)
    views = {t.name: _difference(t, render(t.camera), shown) for t in targets}
    worst = min(views, key=lambda name: views[name]["psnr"])
    psnr, mean, most, white = zip(*(view.values() for view in views.values()), strict=True)
    return {
        "views": len(views),
        "psnr_median": float(np.median(psnr)),
        "psnr_worst": views[worst]["psnr"],
        "worst_view": worst,
        "mean_codes": float(np.mean(mean)),
        "max_codes": max(most),
        "psnr_on_white_median": float(np.median(white)),
        "per_view": views,
    }


def _over(render: Render, background: Float[Array, " 3"]) -> Float[Array, "h w 3"]:
    return render.linear + (1 - render.alpha)[..., None] * background


def _difference(target: Target, render: Render, shown: DisplayTransform | None) -> dict[str, float]:
    """Return PSNR (dB) and differences (8-bit levels) of one view."""

    def from_truth(level: float) -> np.ndarray:
        display = np.asarray(_over(render, jnp.full(3, level)))
        display = np.clip(display, 0, 1) if shown is None else develop(display, shown)
        return np.abs(255.0 * display - target.picture)

    def psnr(difference: np.ndarray) -> float:
        mse = float(np.mean((difference / 255.0) ** 2, dtype=np.float64))
        return float(-10 * np.log10(max(mse, 1e-10)))

    on_black = from_truth(0.0)
    return {
        "psnr": psnr(on_black),
        "mean_codes": float(on_black.mean()),
        "max_codes": float(on_black.max()),
        "psnr_on_white": psnr(from_truth(1.0)),
    }
