"""Scores of recovered radiance against HDR truth (docs/photometry.md, 6)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from p2gs_jax.core.numerics import LN2
from p2gs_jax.evaluation.ssim import ssim

Truth = Callable[[int], Float[np.ndarray, "h w 3"] | None]  # true radiance by row of the view

# PU21, "banding + glare" (Mantiuk and Azimi, Picture Coding Symposium 2021), domain in cd/m^2.
PU21 = (0.353487901, 0.3734658629, 8.277049286e-05, 0.9062562627, 0.09150303166, 0.9099517204)
PU21_SCALE = 596.3148142
PU21_RANGE = (0.005, 10_000.0)
# PU21 maps 100 cd/m^2, a standard display's white, to this value, the peak of PSNR and SSIM.
PU21_PEAK = 256.0
WHITE_NITS = 100.0
# GaussHDR (CVPR 2025) and HDR-NeRF (CVPR 2022): log(1 + mu x) / log(1 + mu), mu = 5000.
MU = 5000.0
# Evenly spaced pixels: of a view for alignment and for colour difference, and of all views for
# alignment. Up to twice as many are used. The last number bounds memory.
ALIGNMENT_PIXELS, COLOR_PIXELS, MOST_ALIGNED = 10_000, 20_000, 1_000_000
STOPS_CAP = 3.0  # larger errors count as this, stops


def pu21_encode(nits: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Return perceptually uniform values of absolute luminance, about 0 to 596."""
    y = np.clip(nits, *PU21_RANGE) ** PU21[3]
    ratio = (PU21[0] + PU21[1] * y) / (1 + PU21[2] * y)
    return PU21_SCALE * (ratio ** PU21[4] - PU21[5])


def pu21_psnr(linear, truth, mask: Bool[np.ndarray, "h w"], white: float) -> float:
    """Return PSNR of PU21-encoded, aligned radiance, dB; radiance `white` counts as 100 cd/m^2."""
    a, b = (pu21_encode(x / white * WHITE_NITS) for x in (linear, truth))
    mse = float(np.mean((a - b)[mask] ** 2)) if mask.any() else float("nan")
    return float(20 * np.log10(PU21_PEAK) - 10 * np.log10(max(mse, 1e-12)))


def pu21_ssim(linear, truth, mask: Bool[np.ndarray, "h w"], white: float) -> float:
    """Return SSIM of PU21-encoded radiance; see `pu21_psnr`."""
    a, b = (
        (pu21_encode(x / white * WHITE_NITS) / PU21_PEAK).astype(np.float32)
        for x in (linear, truth)
    )
    return float(ssim(a, b, np.asarray(mask, np.float32)))


def delta_e_itp(linear, truth, mask: Bool[np.ndarray, "h w"], white: float) -> float:
    """Return the mean colour difference of BT.2124 (1 = just noticeable); see `pu21_psnr`.

    Primaries are sRGB's. The mean is over 20,000 to 40,000 evenly spaced pixels, or all if fewer.
    """
    if not mask.any():
        return float("nan")
    pick = np.flatnonzero(mask)
    pick = pick[:: max(1, len(pick) // COLOR_PIXELS)]

    # Imported here, because colour-science is slow to load.
    import colour

    def encoded(x):
        nits = np.clip(x.reshape(-1, 3)[pick] / white * WHITE_NITS, 0, PU21_RANGE[1])
        wide = colour.RGB_to_RGB(nits, "sRGB", "ITU-R BT.2020")
        return colour.RGB_to_ICtCp(np.maximum(wide, 0))

    return float(np.mean(colour.difference.delta_E_ITP(encoded(linear), encoded(truth))))


def mu_law(x: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Return relative radiance, clipped to [0, 1], compressed by the mu law to [0, 1]."""
    return np.log1p(MU * np.clip(x, 0.0, 1.0)) / np.log1p(MU)


def mu_law_psnr(
    linear: Float[np.ndarray, "h w 3"],
    truth: Float[np.ndarray, "h w 3"],
    mask: Bool[np.ndarray, "h w"],
) -> float:
    """Return PSNR of tone-mapped radiance, dB, as GaussHDR's code computes it for synthetic scenes.

    Both images are divided by the brightest true channel of the view. GaussHDR also rounds them to
    8 bits, this function does not. `linear` is aligned to the truth by one scale for all views.
    The result is NaN if the mask is empty or the truth is black.
    """
    brightest = float(truth[mask].max()) if mask.any() else 0.0
    if brightest <= 0:
        return float("nan")
    a, b = (mu_law(x[mask].astype(np.float64) / brightest) for x in (linear, truth))
    return float(-10 * np.log10(max(float(np.mean((a - b) ** 2)), 1e-12)))


def sampled(linear, truth, mask: Bool[np.ndarray, "h w"], views: int) -> Float[np.ndarray, "2 n 3"]:
    """Return natural logs of recovered and true radiance at pixels of a view, one of `views`."""
    pick = np.flatnonzero(mask & (truth.min(-1) > 0) & (linear.min(-1) > 0))
    each = max(1, min(ALIGNMENT_PIXELS, MOST_ALIGNED // views))
    pick = pick[:: max(1, len(pick) // each)]
    return np.stack([np.log(x.reshape(-1, 3)[pick]) for x in (linear, truth)])


class Alignment(NamedTuple):
    """The alignment of recovered and true radiance, the same for all views.

    The truth is `exp(shift)` times recovered radiance, or `exp(offset) * recovered**power`. A
    recovered radiance of `brightest` saturates the photograph of median exposure; errors in stops
    leave out pixels whose true radiance exceeds `brightest * scale`.
    """

    brightest: float
    shift: float
    power: float
    offset: float

    @classmethod
    def of(cls, samples: Sequence[Float[np.ndarray, "2 _ 3"]], brightest: float) -> Alignment:
        """Return the alignment of samples from all views."""
        # Single precision is too coarse for a line through millions of points.
        recovered, true = np.concatenate(samples, 1).astype(np.float64)
        level, shift = float(np.log(brightest)), 0.0
        kept = recovered.max(-1, initial=-np.inf) < level
        # Recovered radiance selects pixels only until both have a common scale.
        for _ in range(3):
            gap = (true - recovered)[kept]
            shift = float(np.median(gap)) if gap.size else 0.0
            kept = true.max(-1, initial=-np.inf) < level + shift
        logs = np.stack([recovered[kept].ravel(), true[kept].ravel()])
        return cls(brightest, shift, *_power(logs))

    @property
    def scale(self) -> float:
        """True radiance over recovered radiance."""
        return float(np.exp(self.shift))

    def scores(self, linear, truth, mask: Bool[np.ndarray, "h w"]) -> dict[str, float]:
        """Return the scores of a view after alignment by the scale.

        `stops_rms_power` is after alignment by power and offset instead.
        """
        scale, brightest = self.scale, self.brightest
        keep = mask & (truth.min(-1) > 0) & (truth.max(-1) < brightest * scale)
        a, b = np.log2(np.maximum(linear[keep], 1e-12)), np.log2(truth[keep])
        stops = np.minimum(np.abs(a + self.shift / LN2 - b), STOPS_CAP)
        bent = np.minimum(np.abs(self.power * a + self.offset / LN2 - b), STOPS_CAP)
        images = (linear * scale, truth, mask, brightest * scale)
        return {
            "stops_median": float(np.median(stops)) if stops.size else float("nan"),
            "stops_rms": float(np.sqrt(np.mean(stops**2))) if stops.size else float("nan"),
            "stops_rms_power": float(np.sqrt(np.mean(bent**2))) if bent.size else float("nan"),
            "pu21_psnr": pu21_psnr(*images),
            "pu21_ssim": pu21_ssim(*images),
            "delta_e_itp": delta_e_itp(*images),
            "mu_law_psnr": mu_law_psnr(*images[:3]),
        }

    def summary(self, rows: dict[str, dict[str, float]], splits: dict[str, str]) -> dict:
        """Return mean scores over all, training and held-out views, from scores by view name."""
        parts = {
            part: {
                k: _mean([rows[n][k] for n in rows if part in ("all", splits[n])])
                for k in next(iter(rows.values()))
            }
            for part in ("all", "train", "test")
            if part == "all" or part in [splits[n] for n in rows]
        }
        whole = parts.pop("all")
        return {**whole, **parts, "scale": self.scale, "power": self.power, "per_view": rows}


def _mean(values: list[float]) -> float:
    known = [v for v in values if np.isfinite(v)]
    return float(np.mean(known)) if known else float("nan")


def _power(logs: np.ndarray) -> tuple[float, float]:
    """Return (power, offset) with log truth ~ power * log recovered + offset, without outliers."""
    if logs.shape[1] < 2 or np.ptp(logs[0]) < 1e-6:
        return 1.0, 0.0
    keep = np.ones(logs.shape[1], bool)
    power, offset = 1.0, 0.0
    for _ in range(3):
        power, offset = np.polyfit(logs[0][keep], logs[1][keep], 1)
        gap = np.abs(power * logs[0] + offset - logs[1])
        keep = gap < 3 * max(float(np.median(gap)), 1e-3)
    return float(power), float(offset)
