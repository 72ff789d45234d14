"""Points of known radiance seen by three cameras on a car: observations without images.

The input of the photometric adjustment on a drive, with every quantity known: three cameras, frames
one unit apart, facades, road and sky, 4-6 stops of contrast plus a bright sky, 8-bit photographs
with photon noise, texture and outliers (docs/photometry.md, 3 describes a similar one). Cameras
may also tint the light, darken the corners and respond in different ways. Vignetting follows the
cosine-fourth law, so that no fitted polynomial in r^2 is exactly right.
"""

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from p2gs_jax.photometry.observations import Observations
from p2gs_jax.synth.sensor import READ_NOISE, SHOT_NOISE, encode
from p2gs_jax.synth.settings import Curve

Curves = Curve | np.ndarray
Exposures = Literal["constant", "iso2", "iso4", "cameras", "auto"]
YAWS = (0.0, -44.2, 44.8)  # degrees to the left
CAMERA_NAMES = ("front", "right", "left")
HALF_WIDTH, HALF_HEIGHT = 30.0, 21.0  # degrees of the field of view
NEAREST, FARTHEST = 3.0, 45.0  # distances of visible points
LONGEST_TRACK, SHORTEST_TRACK = 30, 3  # observations
MATCHED = 0.6  # share of the visible points
# Extent, in half diagonals, of errors that neighbouring points share; waves that form them.
NEIGHBOURHOOD, WAVES = 0.2, 16


class Drive(NamedTuple):
    """Observations of points by views; a view is camera * frames + frame."""

    views: Int[np.ndarray, " o"]
    points: Int[np.ndarray, " o"]
    radiance: Float[np.ndarray, "p 3"]  # linear
    cameras: Int[np.ndarray, " v"]
    frames: int
    positions: Float[np.ndarray, "o 2"]  # x right, y down, from the centre in half diagonals


def _on_image(azimuth: np.ndarray, height: np.ndarray) -> Float[np.ndarray, "p 2"]:
    """Return positions, in half diagonals, of directions, in degrees to the left and up."""
    a, h = np.radians(azimuth), np.radians(height)
    half_width = np.tan(np.radians(HALF_WIDTH))
    # Directions HALF_HEIGHT up are inside even at the left and right edges.
    half_height = np.tan(np.radians(HALF_HEIGHT)) / np.cos(np.radians(HALF_WIDTH))
    places = np.stack([-np.tan(a), -np.tan(h) / np.cos(a)], axis=1)
    return places / np.hypot(half_width, half_height)


def make_drive(frames: int, points: int, seed: int = 0) -> Drive:
    """Return visibility and radiance of a random street; points are seen at least three times."""
    rng = np.random.default_rng(seed)
    sky, road = points // 8, points // 4
    facade = points - sky - road
    x = np.concatenate([rng.uniform(-5, frames + 45, facade), rng.uniform(3, frames + 40, road)])
    side = rng.choice([-1, 1], facade) * rng.uniform(8, 20, facade)
    y = np.concatenate([side, rng.uniform(-7, 7, road)])
    z = np.concatenate([rng.uniform(-2, 6, facade), np.full(road, -2.0)])
    sky_azimuth, sky_height = rng.uniform(-75, 75, sky), rng.uniform(8, 20, sky)
    views, ids, places = [], [], []
    for frame in range(frames):
        distance = np.hypot(x - frame, y)
        azimuth = np.concatenate([np.degrees(np.arctan2(y, x - frame)), sky_azimuth])
        height = np.concatenate([np.degrees(np.arctan2(z, distance)), sky_height])
        distance = np.concatenate([distance, np.full(sky, 10.0)])
        for camera, yaw in enumerate(YAWS):
            inside = (np.abs(azimuth - yaw) < HALF_WIDTH) & (np.abs(height) < HALF_HEIGHT)
            inside &= (distance > NEAREST) & (distance < FARTHEST) & (rng.random(points) < MATCHED)
            found = np.flatnonzero(inside)
            views.append(np.full(len(found), camera * frames + frame))
            ids.append(found)
            places.append(_on_image(azimuth[found] - yaw, height[found]))
    v, p, xy = map(np.concatenate, (views, ids, places))
    order = rng.permutation(len(v))
    order = order[np.argsort(p[order], kind="stable")]
    v, p, xy = v[order], p[order], xy[order]
    counts = np.bincount(p, minlength=points)
    rank = np.arange(len(p)) - np.concatenate([[0], np.cumsum(counts)])[p]
    keep = (rank < LONGEST_TRACK) & (counts[p] >= SHORTEST_TRACK)
    v, p, xy = v[keep], p[keep], xy[keep]
    kind = np.repeat([0, 1, 2], [facade, road, sky])
    used, p = np.unique(p, return_inverse=True)
    kind = kind[used]
    mean, spread = np.array([-2.5, -2.5, 0.3])[kind], np.array([1.3, 0.5, 0.5])[kind]
    stops = (mean + spread * rng.standard_normal(len(used)))[:, None]
    stops = stops + 0.3 * rng.standard_normal((len(used), 3))
    stops[kind == 2] += [-0.3, 0.0, 0.3]
    return Drive(v, p, 2.0**stops, np.repeat([0, 1, 2], frames), frames, xy)


def make_exposures(drive: Drive, kind: Exposures, seed: int = 2) -> Float[np.ndarray, " v"]:
    """Return exposures > 0 of every view.

    `iso2` and `iso4` draw ISO ~ N(8, std), rounded, at least 1, over 8; `cameras` have one each;
    `auto` drifts slowly, as an automatic exposure does.
    """
    if kind == "constant":
        return np.ones(len(drive.cameras))
    if kind in ("iso2", "iso4"):
        draws = np.random.default_rng(seed).normal(8, float(kind[-1]), len(drive.cameras))
        return np.maximum(np.round(draws), 1) / 8
    if kind == "cameras":
        return np.array([1.0, 0.7, 1.4])[drive.cameras]
    phase = 2.6 * np.pi * np.arange(drive.frames) / drive.frames
    of_cameras = [0.8 * np.sin(phase + 2.1 * k) + v for k, v in enumerate((0.0, -0.3, 0.3))]
    return 2.0 ** np.concatenate(of_cameras)


def observe(
    drive: Drive,
    exposures: Float[np.ndarray, " v"] | Float[np.ndarray, "v 3"],
    *,
    curve: Curves = "srgb",
    gammas: Float[np.ndarray, " v"] | None = None,
    pivot: float = 1.0,
    outliers: float = 0.08,
    texture: float = 0.03,
    noise: float = 1.0,
    bits: int | None = 8,
    corner_loss: Float[np.ndarray, "c k"] | None = None,
    shared_texture: float = 0.0,
    seed: int = 3,
) -> Observations:
    """Photograph the points under exposures of every view, or of every view and channel.

    `curve` is the response, or an array of names that fits cameras x channels; `gammas` of every
    view replace it by x^(1 / gamma) about the pivot, the linear value that they leave alone.
    `outliers` is the share of observations that show another point, `texture` the standard
    deviation of log radiance between views, `shared_texture` that of errors that neighbours in an
    image share, `noise` a factor of photon noise and texture; `bits=None` does not round;
    `corner_loss` is the share of the light that each camera loses in its corners.
    """
    rng = np.random.default_rng(seed)
    v, p = drive.views, drive.points
    shown = p.copy()
    wrong = rng.random(len(p)) < outliers
    shown[wrong] = rng.integers(0, len(drive.radiance), int(wrong.sum()))
    exposed = exposures.reshape(len(exposures), -1)[v] * drive.radiance[shown]
    if corner_loss is not None:
        radius = np.linalg.norm(drive.positions, axis=1)[:, None]
        exposed = exposed * falloff(radius, corner_loss[drive.cameras[v]])
    exposed = exposed * np.exp(noise * texture * rng.standard_normal((len(p), 1)))
    if shared_texture:
        common = smooth_errors(drive, (seed, 1))
        exposed = exposed * np.exp(shared_texture * common[:, None])
    shot = np.sqrt(SHOT_NOISE * exposed + READ_NOISE)
    exposed = np.maximum(exposed + noise * shot * rng.standard_normal(exposed.shape), 0)
    if gammas is None:
        ldr = encode_by(exposed, curve, drive.cameras[v])
    else:
        ldr = pivot ** (1 / 2.2) * (exposed / pivot) ** (1 / gammas[v][:, None])
    ldr = np.clip(ldr, 0, 1)
    if bits is not None:
        ldr = np.round(ldr * (2**bits - 1)) / (2**bits - 1)
    known = {"view_count": len(drive.cameras), "point_count": len(drive.radiance)}
    known |= {"cameras": drive.cameras, "positions": drive.positions, "camera_names": CAMERA_NAMES}
    return Observations(views=v, points=p, colors=ldr, spread=np.zeros_like(ldr), **known)


def falloff(radius: np.ndarray, corner_loss: np.ndarray) -> np.ndarray:
    """Return the share of the light that arrives: cos^4 of the angle to the axis.

    The radius is 1 in the corners of the image, where a share in [0, 1) is lost.
    """
    # cos^2 = 1 / (1 + tan^2), and the tangent grows with the radius.
    return (1 + ((1 - corner_loss) ** -0.5 - 1) * radius**2) ** -2.0


def encode_by(exposed: Float[np.ndarray, "o 3"], curve: Curves, cameras: np.ndarray) -> np.ndarray:
    """Return display values of exposed radiance; curves broadcast to (cameras, 3)."""
    if isinstance(curve, str):
        return encode(exposed, curve)
    of_each = np.broadcast_to(curve, (int(cameras.max(initial=0)) + 1, 3))[cameras]
    out = np.empty_like(exposed)
    for name in np.unique(of_each):
        out[of_each == name] = encode(exposed[of_each == name], name)
    return out


def smooth_errors(drive: Drive, seed: tuple[int, ...]) -> Float[np.ndarray, " o"]:
    """Return errors of variance 1 that vary smoothly over each image and differ between images.

    Sums of random waves approach a Gaussian process with the covariance
    exp(-d^2 / (2 NEIGHBOURHOOD^2)) (Rahimi and Recht 2007).
    """
    rng, views = np.random.default_rng(seed), drive.views
    total = np.zeros(len(views))
    for _ in range(WAVES):
        wave = rng.standard_normal((len(drive.cameras), 2)) / NEIGHBOURHOOD
        phase = rng.uniform(0, 2 * np.pi, len(drive.cameras))
        total += np.cos((wave[views] * drive.positions).sum(1) + phase[views])
    return total * np.sqrt(2 / WAVES)
