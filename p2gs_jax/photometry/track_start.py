"""A first, simple start of the exposures: robust log-ratios of unsaturated colours over tracks.

Model: z = log EOTF(I) = log e_view + log L_point + noise. The points are eliminated exactly
(variable projection), the views solved from a sparse Schur complement, and outliers are weighted
away: two L1 rounds, then Geman-McClure (PHOTOMETRY section 4). The full bundle adjustment of tone
curves replaces this module's solver behind the same result.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Int
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import spsolve

from p2gs_jax.config import LossConfig, PhotometryConfig

MIN_OBSERVATIONS = 15
ITERATIONS, L1_ITERATIONS = 30, 4
TOLERANCE = 1e-6
# Noise model: 8-bit quantisation, photon noise, and a floor for texture and misplacement.
SHOT_NOISE, READ_NOISE, TEXTURE = 2e-4, 1e-6, 0.03
GEMAN_MCCLURE = 3.0


@dataclass(frozen=True)
class TrackStart:
    """Exposures from tracks.

    Attributes:
        log_exposures: natural logarithm, mean 0 over each component; 0 where unobserved.
        standard_errors: of `log_exposures`; inf where unobserved.
        observations_per_view: usable observations.
        component: views with equal numbers share a scale; others cannot be compared.
        point_log_radiance: natural logarithm per channel; NaN where unobserved.
        residual_ev: robust standard deviation of one observation, in stops.
        warnings: what the user should know.
    """

    log_exposures: Float[np.ndarray, " v"]
    standard_errors: Float[np.ndarray, " v"]
    observations_per_view: Int[np.ndarray, " v"]
    component: Int[np.ndarray, " v"]
    point_log_radiance: Float[np.ndarray, "p 3"]
    residual_ev: float
    warnings: tuple[str, ...]


def log_linear(
    colors: Float[np.ndarray, "o 3"], curve: str
) -> tuple[Float[np.ndarray, "o 3"], Float[np.ndarray, "o 3"]]:
    """Return log linear values and their standard deviations."""
    y = np.clip(colors, 0.5 / 255, 1.0)
    if curve == "power":
        x, slope = y**2.2, 2.2 * y**1.2
    else:
        base = (y + 0.055) / 1.055
        x = np.where(y <= 0.04045, y / 12.92, base**2.4)
        slope = np.where(y <= 0.04045, 1 / 12.92, 2.4 / 1.055 * base**1.4)
    quantisation = slope / x / (255 * np.sqrt(12))
    shot = np.sqrt(SHOT_NOISE * x + READ_NOISE) / x
    return np.log(x), np.sqrt(quantisation**2 + shot**2 + TEXTURE**2)


def start_from_tracks(
    views: Int[np.ndarray, " o"],
    points: Int[np.ndarray, " o"],
    colors: Float[np.ndarray, "o 3"],
    *,
    view_count: int,
    point_count: int,
    cfg: PhotometryConfig,
    loss: LossConfig,
) -> TrackStart:
    """Solve per-view log exposures from observations of the same points.

    Args:
        views: row of the training view of each observation.
        points: row of its point.
        colors: display-encoded colours.
        view_count: number of training views.
        point_count: number of points.
        cfg: base curve.
        loss: saturation and black thresholds.
    """
    z, sigma = log_linear(np.asarray(colors, np.float64), cfg.curve)
    usable = ((colors > loss.black) & (colors < loss.saturation)).astype(np.float64)
    base = usable / sigma**2
    any_usable = usable.sum(1) > 0
    shared = np.bincount(points[any_usable], minlength=point_count)[points] >= 2
    base = base * (any_usable & shared)[:, None]
    per_view = np.bincount(views[base.sum(1) > 0], minlength=view_count)
    incidence = sp.csr_matrix(
        ((base.sum(1) > 0).astype(float), (views, points)), shape=(view_count, point_count)
    )
    component = _components(incidence)

    def sum_points(w):
        return np.stack([np.bincount(points, w[:, c], point_count) for c in range(3)], 1)

    log_e = np.zeros(view_count)
    weight = base
    scale, radiance, precision = 1.0, np.zeros((point_count, 3)), np.ones((point_count, 3))
    normal = sp.identity(view_count, format="csc")
    active = per_view > 0
    for iteration in range(ITERATIONS if active.any() else 0):
        precision = sum_points(weight)
        radiance = sum_points(weight * (z - log_e[views, None])) / (precision + 1e-12)
        residual = z - log_e[views, None] - radiance[points]
        u = residual / sigma
        scale = max(1.4826 * float(np.median(np.abs(u[base > 0]))), 0.3)
        if iteration < L1_ITERATIONS:
            robust = 1 / np.maximum(np.abs(u) / scale, 0.5)
        else:
            # One weight for the whole observation: an outlier is wrong in all channels.
            mean_square = (u**2 * (base > 0)).sum(1) / np.maximum((base > 0).sum(1), 1)
            robust = (1 / (1 + mean_square / (GEMAN_MCCLURE * scale) ** 2) ** 2)[:, None]
        weight = base * robust
        precision = sum_points(weight)
        radiance = sum_points(weight * (z - log_e[views, None])) / (precision + 1e-12)
        residual = z - log_e[views, None] - radiance[points]
        right = np.bincount(views, (weight * residual).sum(1), view_count)
        coupling = [
            sp.csr_matrix((weight[:, c], (views, points)), shape=(view_count, point_count))
            for c in range(3)
        ]
        normal = sp.diags(np.bincount(views, weight.sum(1), view_count)) - sum(
            m @ sp.diags(1 / (precision[:, c] + 1e-12)) @ m.T for c, m in enumerate(coupling)
        )
        anchored = (normal + _gauge(component, normal)).tocsc()
        step = np.asarray(spsolve(anchored, right))
        log_e = _centered(log_e + np.where(active, step, 0.0), component, active)
        if iteration > L1_ITERATIONS + 2 and np.abs(step).max() < TOLERANCE:
            break

    point_log = np.where(precision > 0, radiance, np.nan)
    point_log = np.where(sum_points(base) > 0, point_log, np.nan)
    errors = _standard_errors(normal, component, active, scale)
    residual_ev = scale * float(np.median(sigma[base > 0])) / np.log(2) if active.any() else 0.0
    return TrackStart(
        log_e,
        errors,
        per_view,
        component,
        point_log,
        residual_ev,
        _warnings(per_view, component, active),
    )


def _components(incidence: sp.csr_matrix) -> np.ndarray:
    shared = incidence @ incidence.T
    return connected_components(shared, directed=False)[1]


def _gauge(component: np.ndarray, normal) -> sp.csr_matrix:
    """Return a rank-one anchor per component: the mean of log e is held at zero."""
    strength = float(normal.diagonal().mean()) + 1e-9
    members = sp.csr_matrix(
        (np.ones(len(component)), (component, np.arange(len(component)))),
        shape=(component.max() + 1, len(component)),
    )
    sizes = np.asarray(members.sum(1)).ravel()
    anchor = members.T @ sp.diags(strength / sizes) @ members
    return anchor + sp.identity(len(component)) * (1e-9 * strength)


def _centered(log_e: np.ndarray, component: np.ndarray, active: np.ndarray) -> np.ndarray:
    counts = np.bincount(component[active], minlength=component.max() + 1)
    sums = np.bincount(component[active], log_e[active], component.max() + 1)
    return np.where(active, log_e - (sums / np.maximum(counts, 1))[component], 0.0)


def _standard_errors(normal, component, active, scale: float) -> np.ndarray:
    """Return Gauss-Newton standard errors under the gauge mean log e = 0."""
    if not active.any():
        return np.full(len(active), np.inf)
    inverse = np.linalg.pinv(np.asarray(normal.todense()), hermitian=True)
    return np.where(active, scale * np.sqrt(np.maximum(np.diag(inverse), 0)), np.inf)


def _warnings(per_view, component, active) -> tuple[str, ...]:
    out = []
    few = np.flatnonzero(per_view < MIN_OBSERVATIONS)
    if len(few):
        out.append(
            f"{len(few)} training view(s) have fewer than {MIN_OBSERVATIONS} usable track "
            f"observations; their exposures are uncertain (rows {_listed(few)})."
        )
    groups = len(set(component[active].tolist()))
    if groups > 1:
        out.append(
            f"The tracks fall into {groups} groups of views that share no point: exposures can "
            "be compared only inside a group."
        )
    return tuple(out)


def _listed(rows: np.ndarray) -> str:
    head = ", ".join(str(r) for r in rows[:8])
    return head + (", ..." if len(rows) > 8 else "")
