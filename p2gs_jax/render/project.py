"""Projection of 3D Gaussians, static or moving, to 2D splats and their radiance in one view.

Splats use the local affine approximation of EWA splatting. Drives add two kinds of motion:

Moving objects. Gaussians stay in the frame of their box, and the camera moves: the view matrix of
an object's Gaussians maps its box to the camera (`camera_of_each`).

Vibration (PVG, arXiv 2311.18561, section 3.2). Gaussians may appear, move and disappear:

    mean(t)    = mean + velocity sin(2 pi (t - peak) / cycle) cycle / (2 pi) still(life)
    opacity(t) = opacity exp(-(t - peak)^2 / (2 life^2))

PVG separates moving from static Gaussians by `still` = exp(-life / (2 cycle)). There it scales the
displayed velocity; here it scales the motion itself, so that Gaussians of a long life do not move
(ours).
"""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from p2gs_jax.config import RenderConfig
from p2gs_jax.core.numerics import matmul, namespace
from p2gs_jax.render import harmonics
from p2gs_jax.render.xla_cpu import columns
from p2gs_jax.types import Camera, Frustum, Gaussians, Placement, Splats2D

AnyCamera = TypeVar("AnyCamera", bound=Camera | Frustum)

INVISIBLE_LOG_OPACITY = -100.0
# Log scene units; outside this range float32 products with focal lengths are not normal numbers.
LOG_SCALE_RANGE = (-16.0, 9.0)
# The affine approximation is evaluated at most this many half image sizes from the axis.
TANGENT_LIMIT = 1.3
# View matrix of objects that are absent from a view: every point is behind the camera.
HIDDEN = np.array([[0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, -1], [0, 0, 0, 1]], np.float32)
# Cycle of a vibration, seconds (PVG: 10 photographs at 10 Hz).
CYCLE = 1.0
# Life of static Gaussians, seconds: their opacity is constant, and the life gets no gradient.
STILL = math.exp(30.0)
# Log opacities of vibrating Gaussians stay within these bounds, so that their logits are finite.
FAINTEST, MOST_OPAQUE = -30.0, -1e-6


def at_time(gaussians: Gaussians, objects: Placement | None) -> Gaussians:
    """Return the Gaussians at the time of a view; unchanged if none vibrates.

    `objects` holds the time of the view; None means the middle of the drive. NumPy arrays give
    NumPy results.
    """
    moves = gaussians.vibration
    if moves is None:
        return gaussians
    time = None if objects is None else objects.time
    t: Float[Array, ""] | np.ndarray = np.zeros((), np.float32) if time is None else time
    xp = namespace(gaussians.means, t)
    life = xp.exp(moves.log_lives)
    since_peak = t - moves.peaks
    swing = xp.sin(since_peak * (2 * math.pi / CYCLE)) * (CYCLE / (2 * math.pi))
    swing = swing * xp.exp(-life / (2 * CYCLE))
    log_opacity = -xp.logaddexp(0.0, -gaussians.opacity_logits) - 0.5 * (since_peak / life) ** 2
    log_opacity = xp.clip(log_opacity, FAINTEST, MOST_OPAQUE)
    return dataclasses.replace(
        gaussians,
        means=gaussians.means + moves.velocities * swing[:, None],
        opacity_logits=log_opacity - xp.log(-xp.expm1(log_opacity)),
        vibration=None,
    )


def camera_of_each(camera: AnyCamera, owner: Int[Array | np.ndarray, " n"] | None) -> AnyCamera:
    """Return a camera with the view matrix of each Gaussian, along the last axis.

    `owner` is the moving object of each Gaussian, -1: none; with None the camera is unchanged. In a
    view without `objects`, all moving objects are hidden.
    """
    if owner is None:
        return camera
    xp = namespace(owner, camera.viewmat)
    objects = xp.asarray(HIDDEN)[None] if camera.objects is None else camera.objects.viewmats
    # The view matrix of the world is last, so that index -1 selects it.
    stack = xp.concatenate([objects, camera.viewmat[None]])
    row = xp.minimum(owner, len(objects) - 1)
    # The axis of Gaussians is last, so that each entry of the matrices is one vector.
    return dataclasses.replace(camera, viewmat=xp.moveaxis(stack, 0, -1)[:, :, row], objects=None)


def rotation_matrices(quats: Float[Array, "n 4"]) -> list[list[Float[Array, " n"]]]:
    """Return rotation matrices of wxyz quaternions as 3x3 nested lists of vectors.

    Quaternions are normalised first; a zero quaternion gives the identity.
    """
    raw = columns(quats)
    # Dividing by the largest component first keeps the squares in range for any length.
    largest = jax.lax.stop_gradient(functools.reduce(jnp.maximum, [jnp.abs(c) for c in raw]))
    zero = largest < 1e-30
    raw = [c / jnp.where(zero, 1, largest) for c in raw]
    inverse = jax.lax.rsqrt(jnp.where(zero, 1, sum(c * c for c in raw)))
    w, x, y, z = (jnp.where(zero, float(i == 0), c * inverse) for i, c in enumerate(raw))
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]


def rotated(R: list[list[Float[Array, " n"]]], local: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Return vectors along principal axes in world coordinates; `R` is from `rotation_matrices`."""
    return jnp.stack([sum(R[i][j] * local[:, j] for j in range(3)) for i in range(3)], -1)


def project(
    gaussians: Gaussians, alive: Bool[Array, " n"], camera: Camera | Frustum, cfg: RenderConfig
) -> Splats2D:
    """Project Gaussians into a view.

    Splats that are not alive, not beyond the near plane, or not finite are invisible and have zero
    gradients. The determinant of the 2D covariance is a sum of squared minors (Cauchy-Binet)
    instead of a difference, so that needles keep a positive determinant in float32.
    """
    R, t = camera.viewmat[:3, :3], camera.viewmat[:3, 3]
    fx, fy, cx, cy = camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]
    means = columns(gaussians.means)
    x, y, z_raw = (sum(means[k] * R[i, k] for k in range(3)) + t[i] for i in range(3))
    visible = alive & (z_raw > cfg.near)
    # Masking the inputs, not the results, keeps the gradients of invisible splats at exactly zero.
    z = jnp.where(visible, z_raw, 1.0)
    x, y = jnp.where(visible, x, 0.0), jnp.where(visible, y, 0.0)
    inverse_z = 1.0 / z

    limit_x = TANGENT_LIMIT * camera.width / (2 * fx)
    limit_y = TANGENT_LIMIT * camera.height / (2 * fy)
    tangent_x = jnp.clip(x * inverse_z, -limit_x, limit_x)
    tangent_y = jnp.clip(y * inverse_z, -limit_y, limit_y)
    j00, j02 = fx * inverse_z, -fx * tangent_x * inverse_z
    j11, j12 = fy * inverse_z, -fy * tangent_y * inverse_z
    JR = (
        [j00 * R[0, k] + j02 * R[2, k] for k in range(3)],
        [j11 * R[1, k] + j12 * R[2, k] for k in range(3)],
    )
    Q = rotation_matrices(gaussians.quats)
    scales = [jnp.exp(jnp.clip(s, *LOG_SCALE_RANGE)) for s in columns(gaussians.log_scales)]
    V = [
        [sum(JR[i][k] * Q[k][axis] for k in range(3)) * scales[axis] for axis in range(3)]
        for i in range(2)
    ]
    s_xx, s_yy = (sum(v * v for v in V[i]) for i in range(2))
    s_xy = sum(V[0][axis] * V[1][axis] for axis in range(3))
    minors = [V[0][i] * V[1][j] - V[0][j] * V[1][i] for i, j in ((0, 1), (0, 2), (1, 2))]
    det = sum(m * m for m in minors) + cfg.blur * (s_xx + s_yy) + cfg.blur**2
    c_xx, c_yy = s_xx + cfg.blur, s_yy + cfg.blur

    mean_x, mean_y = fx * x * inverse_z + cx, fy * y * inverse_z + cy
    finite = jnp.isfinite(det) & jnp.isfinite(mean_x) & jnp.isfinite(mean_y) & (det > 0)
    visible = visible & finite
    a11 = jnp.sqrt(c_yy / det)
    log_opacities = jnp.where(
        visible, -jax.nn.softplus(-gaussians.opacity_logits), INVISIBLE_LOG_OPACITY
    )
    return Splats2D(
        means2d=jnp.stack([mean_x, mean_y], -1),
        conic_factor=jnp.stack([a11, -s_xy / c_yy * a11, jax.lax.rsqrt(c_yy)], -1),
        cov_diagonal=jnp.stack([c_xx, c_yy], -1),
        log_opacities=log_opacities,
        depths=z,
        visible=visible,
    )


def view_radiance(
    gaussians: Gaussians,
    camera: Camera | Frustum,
    cfg: RenderConfig,
    active_degree: Int[Array, ""] | int | None = None,
) -> Float[Array, "n 3"]:
    """Return each Gaussian's linear HDR radiance towards the camera, >= 0."""
    if camera.viewmat.ndim == 2:
        center = -matmul(camera.viewmat[:3, :3].T, camera.viewmat[:3, 3])
    else:
        # Camera centre in the frame of each Gaussian.
        R, t = camera.viewmat[:3, :3], camera.viewmat[:3, 3]
        center = [-sum(R[i, k] * t[i] for i in range(3)) for k in range(3)]
    offset = [m - c for m, c in zip(columns(gaussians.means), center, strict=True)]
    inverse = jax.lax.rsqrt(jnp.maximum(sum(o * o for o in offset), 1e-20))
    x, y, z = (o * inverse for o in offset)
    values = harmonics.evaluate(gaussians.sh, (x, y, z), active_degree)
    return harmonics.radiance_activation(values, cfg.radiance)
