"""Metrics of the benches, each declared once with its direction and tolerance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from p2gs_jax.bench.oracle import Truth
from p2gs_jax.core.srgb import srgb_encode
from p2gs_jax.types import Gaussians

FIELDS = ("means", "quats", "log_scales", "opacity_logits", "sh")
# Radiances below this part of the image's largest are held to it in relative errors.
DARKEST = 1e-4


@dataclass(frozen=True)
class Metric:
    """One column of a bench.

    Attributes:
        title: table heading, with the unit.
        better: which way is good.
        tolerance: how far a value may be worse than the baseline before the gate closes; a factor
            where `absolute` is false, else in the metric's unit.
        absolute: see `tolerance`.
        timed: a ratio of wall times, which other work on the machine moves.
    """

    title: str
    better: Literal["lower", "higher"]
    tolerance: float
    absolute: bool = False
    timed: bool = False

    def worse(self, value: float, baseline: float) -> bool:
        """Return whether `value` is worse than `baseline` allows; NaN always is."""
        sign = 1.0 if self.better == "lower" else -1.0
        limit = (
            baseline + sign * self.tolerance if self.absolute else baseline * self.tolerance**sign
        )
        return not sign * value <= sign * limit


# Accuracy is deterministic up to the order of float32 sums; times are ratios to a reference
# workload of the same run and still move with the machine: 1.8 times between two, by our own CI.
METRICS = {
    "max_abs": Metric("max abs", "lower", 1.25),
    "relative": Metric("relative max", "lower", 1.25),
    "psnr": Metric("PSNR dB", "higher", 0.5, absolute=True),
    "gradient": Metric("gradient rel. L2", "lower", 1.25),
    "relative_99": Metric("relative, 99 %", "lower", 1.5),
    "gradient_99": Metric("gradient, best 99 %", "lower", 1.5),
    "forward": Metric("forward / reference", "lower", 2.5, timed=True),
    "both": Metric("forward + backward / reference", "lower", 2.5, timed=True),
    "step": Metric("training step / reference", "lower", 2.5, timed=True),
}
ACCURACY = ("max_abs", "relative", "psnr", "gradient")


def image_errors(
    linear: Float[np.ndarray, "h w 3"], exact: Float[np.ndarray, "h w 3"]
) -> dict[str, float]:
    """Return the accuracy metrics of a render.

    `max_abs` is in linear radiance exposed so that the truth's mean is 0.18; `relative` is the
    largest error of a pixel over its brightest channel; `psnr` is of the sRGB encoding of the
    exposed image.
    """
    exposure = 0.18 / max(float(exact.mean()), 1e-30)
    error = np.abs(linear - exact)
    brightest = exact.max(-1)
    brightest = np.maximum(brightest, DARKEST * brightest.max())
    mse = np.mean((srgb_encode(linear * exposure) - srgb_encode(exact * exposure)) ** 2)
    return {
        "max_abs": float(error.max() * exposure),
        "relative": float((error.max(-1) / brightest).max()),
        "psnr": float(-10 * np.log10(max(mse, 1e-30))),
    }


def errors(
    linear: Float[np.ndarray, "h w 3"], gradient: Gaussians, truth: Truth
) -> dict[str, float]:
    """Return the accuracy metrics of a render and its gradient.

    `gradient` is the relative L2 error of the worst parameter group; the others: `image_errors`.
    """
    groups = []
    for name in FIELDS:
        a, b = np.asarray(getattr(gradient, name), np.float64), getattr(truth.gradient, name)
        groups.append(np.linalg.norm(a - b) / max(np.linalg.norm(b), 1e-30))
    return {**image_errors(linear, truth.linear), "gradient": float(max(groups))}


def trimmed_errors(
    linear: Float[np.ndarray, "h w 3"], gradient: Gaussians, truth: Truth
) -> dict[str, float]:
    """Return accuracy without the worst percent, of pixels and of Gaussians.

    Where many splats meet at a pixel, some contributions lie on the cutoff itself, and float32 and
    float64 may decide differently; a few of these would dominate the metrics.
    """
    error = np.abs(linear - truth.linear).max(-1)
    brightest = truth.linear.max(-1)
    relative = error / np.maximum(brightest, DARKEST * brightest.max())
    groups = []
    for name in FIELDS:
        a, b = np.asarray(getattr(gradient, name), np.float64), getattr(truth.gradient, name)
        off = np.linalg.norm((a - b).reshape(len(a), -1), axis=1)
        kept = off[off <= np.quantile(off, 0.99)]
        groups.append(np.linalg.norm(kept) / max(np.linalg.norm(b), 1e-30))
    return {"relative_99": float(np.quantile(relative, 0.99)), "gradient_99": float(max(groups))}
