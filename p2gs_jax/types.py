"""Every record that several packages share, on one page.

Device records are `equinox.Module` pytrees; host records are frozen dataclasses of numpy arrays.

Conventions (docs/conventions.md): OpenCV camera axes (x right, y down, z forward), world-to-camera
`viewmats`, pixel centres at +0.5 as in COLMAP, lengths in scene units (metres where the source is
metric), radiance linear and relative to the gauge of `Photometry`, LDR in [0, 1].
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float32, Float64, Int, UInt, UInt8

if not TYPE_CHECKING:
    # Device records may also hold host arrays and scalars; type checkers see only device arrays.
    Array = Array | np.ndarray | np.generic

Split = Literal["train", "test"]
AlphaUse = Literal["background", "mask", "ignore"]
ColmapLens = Literal["FOV", "DIVISION", "EUCM", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE"]
LensModel = Literal["radial", "fisheye"] | ColmapLens


def _namespace(values) -> Any:
    """Return numpy for host arrays, as used before and after a fit, and JAX for all others."""
    return np if isinstance(values, np.ndarray) else jnp


def _at_least(values, floor: float) -> Any:
    """Return the larger of each value and the floor; the gradient is 1 in both cases."""
    if isinstance(values, np.ndarray):
        return np.maximum(values, floor)
    return jnp.where(values > floor, values, floor + (values - jax.lax.stop_gradient(values)))


GAMMA_SRGB = 2.2  # gamma under which a tone curve equals its base, such as sRGB
# Weights of red, green and blue in the luminance of display values (BT.601).
LUMINANCE = (0.299, 0.587, 0.114)


class Vibration(eqx.Module):
    """Motion and lifetime of Gaussians (render/project.py)."""

    velocities: Float[Array, "n 3"]  # velocity at the peak, scene units per second
    peaks: Float[Array, " n"]  # time of the largest opacity, seconds from the middle of the drive
    log_lives: Float[Array, " n"]  # log standard deviations of the opacity over time, log seconds


class Gaussians(eqx.Module):
    """The scene: N anisotropic Gaussians carrying linear HDR radiance.

    Attributes:
        means: centres, scene units.
        quats: rotations, wxyz, normalised when used.
        log_scales: log standard deviations along the rotated axes, log scene units.
        opacity_logits: logits of the peak opacity.
        sh: spherical-harmonics coefficients, K = (degree + 1)^2, of pre-activation radiance.
        vibration: motion and lifetime; None: the Gaussians are static.
    """

    means: Float[Array, "n 3"]
    quats: Float[Array, "n 4"]
    log_scales: Float[Array, "n 3"]
    opacity_logits: Float[Array, " n"]
    sh: Float[Array, "n k 3"]
    vibration: Vibration | None = eqx.field(kw_only=True, default=None)

    @property
    def capacity(self) -> int:
        """Number of slots, alive or not."""
        return self.means.shape[0]

    @property
    def all_alive(self) -> Bool[Array, " n"]:
        """The mask of live slots if there are no empty ones."""
        return jax.device_put(np.ones(self.capacity, bool))


class Capture(eqx.Module):
    """Photometric parameters of one photograph, or of the photograph of each of some pixels.

    Attributes:
        exposure: e > 0.
        gamma: > 0.
        white_balance: log factors on red, green, blue beside e, mean 0; None: all factors are 1.
        camera: row in `PhotometryConfig.cameras`, -1 for a camera without a row; None where no
            camera has vignetting or a response curve.
    """

    exposure: Float[Array, "*m"]
    gamma: Float[Array, "*m"]
    white_balance: Float[Array, "*m 3"] | None = None
    camera: Int[Array, "*m"] | int | None = None


class Photometry(eqx.Module):
    """Photometric parameters of the training views: exposure, gamma and white balance.

    Attributes:
        raw_exposures: parameters of the optimiser: log e (`log`) or e (`linear`).
        raw_gammas: parameters of the optimiser: log(gamma / 2.2) (`log`) or gamma (`linear`).
        parameterization: `log` keeps both positive by construction; `linear` is the paper's.
        raw_white_balance: log factors on the channels; their mean has no effect, because exposures
            hold it. None where the white balance does not vary.
        cameras: row of each view in `PhotometryConfig.cameras`; None where that is empty.
    """

    raw_exposures: Float[Array, " v"]
    raw_gammas: Float[Array, " v"]
    parameterization: Literal["log", "linear"] = eqx.field(static=True, default="log")
    raw_white_balance: Float[Array, "v 3"] | None = None
    cameras: tuple[int, ...] | None = eqx.field(static=True, default=None)

    @property
    def exposures(self) -> Float[Array, " v"]:
        """Exposures e > 0, dimensionless."""
        if self.parameterization == "log":
            return _namespace(self.raw_exposures).exp(self.raw_exposures)
        return _at_least(self.raw_exposures, 1e-3)

    @property
    def log_exposures(self) -> Float[Array, " v"]:
        """Logarithms of the exposures, also of those outside the normal range of float32."""
        if self.parameterization == "log":
            return self.raw_exposures
        return _namespace(self.raw_exposures).log(self.exposures)

    @property
    def gammas(self) -> Float[Array, " v"]:
        """Gammas > 0."""
        if self.parameterization == "log":
            return GAMMA_SRGB * _namespace(self.raw_gammas).exp(self.raw_gammas)
        return _at_least(self.raw_gammas, 1e-3)

    @property
    def white_balance(self) -> Float[Array, "v 3"] | None:
        """Log factors on red, green, blue, mean 0 in every view, or None."""
        raw = self.raw_white_balance
        return None if raw is None else raw - raw.mean(axis=1, keepdims=True)

    def capture(self, row: Int[Array, "..."] | int) -> Capture:
        """Return the photometric parameters of the training view in a row, or in several rows."""
        balance = self.white_balance
        camera = None
        if self.cameras is not None:
            camera = _namespace(self.raw_exposures).asarray(self.cameras)[row]
        return Capture(
            self.exposures[row], self.gammas[row], None if balance is None else balance[row], camera
        )


class Params(eqx.Module):
    """The one differentiable pytree."""

    gaussians: Gaussians
    photometry: Photometry
    appearance: Any = None
    """Corrections of all training views (`Corrections` of photometry/appearance.py), or None."""


class Placement(eqx.Module):
    """Poses of the moving objects in one view, and its time."""

    # box-to-camera of each object, OpenCV axes; absent objects are behind the camera
    viewmats: Float[Array, "k 4 4"]
    # time of the view, seconds from the middle of the drive; None where no Gaussian vibrates
    time: Float[Array, ""] | None = None


class Camera(eqx.Module):
    """A pinhole camera.

    Attributes:
        viewmat: world-to-camera, OpenCV axes; or one matrix per Gaussian, from `camera_of_each`.
        K: intrinsics in pixels, pixel centres at +0.5.
        width: pixels, static.
        height: pixels, static.
        objects: poses of moving objects; None: the camera shows none.
    """

    viewmat: Float[Array, "4 4"] | Float[Array, "4 4 n"]
    K: Float[Array, "3 3"]
    width: int = eqx.field(static=True)
    height: int = eqx.field(static=True)
    objects: Placement | None = None


class Frustum(eqx.Module):
    """A camera whose image size is traced: per-Gaussian programs compile once for all sizes.

    `Camera` describes the attributes.
    """

    viewmat: Float[Array, "4 4"] | Float[Array, "4 4 n"]
    K: Float[Array, "3 3"]
    width: Float[Array, ""]
    height: Float[Array, ""]
    objects: Placement | None = None


class Splats2D(eqx.Module):
    """Gaussians projected into one view.

    The inverse 2D covariance is kept as its Cholesky factor: with u = a11 dx + a12 dy and
    v = a22 dy the exponent is log o - (u^2 + v^2) / 2.
    """

    means2d: Float[Array, "n 2"]  # projected centres, pixels
    conic_factor: Float[Array, "n 3"]  # (a11, a12, a22), 1 / pixels
    # (Sxx, Syy) of the 2D covariance, pixels^2; they give the extent of the bounding box
    cov_diagonal: Float[Array, "n 2"]
    log_opacities: Float[Array, " n"]  # log peak opacity (-100 where not visible)
    depths: Float[Array, " n"]  # z in the camera, scene units
    visible: Bool[Array, " n"]  # in front of the near plane and well defined


class TileList(eqx.Module):
    """The Gaussians that each tile composites, in depth order, as one flat list."""

    gaussian_ids: Int[Array, " m"]  # ids sorted by (tile, depth), padded to the capacity M
    # start of every tile in `gaussian_ids`; the last is the number of entries used
    offsets: Int[Array, " t1"]
    count: Int[Array, ""]  # number of entries of the complete list
    # count > M; the list is then incomplete and the result must be discarded
    overflow: Bool[Array, ""]


class Render(eqx.Module):
    """One rendered view.

    Attributes:
        linear: linear HDR radiance, premultiplied by alpha, before `RenderConfig.background`.
        alpha: accumulated opacity in [0, 1].
        depth: alpha-weighted camera z; divided by alpha it is the expected depth. None if it was
            not requested.
        count: number of tile-list entries that this view needs.
        overflow: the tile list did not fit: discard this render and increase the capacity.
        visible: which Gaussians are in the image.
    """

    linear: Float[Array, "h w 3"]
    alpha: Float[Array, "h w"]
    depth: Float[Array, "h w"] | None
    count: Int[Array, ""]
    overflow: Bool[Array, ""]
    visible: Bool[Array, " n"]


class Population(eqx.Module):
    """Slots in use and the statistics for densification; never differentiated."""

    alive: Bool[Array, " n"]  # slots in use
    # summed norms of the screen-space mean gradients, units of half the image
    grad2d_sum: Float[Array, " n"]
    seen_count: Float[Array, " n"]  # number of views that contributed to `grad2d_sum`
    # row of the moving object to whose box a Gaussian is attached, -1: none; None where nothing
    # moves
    owner: Int[Array, " n"] | None = None


class Measured(eqx.Module):
    """Depths of LiDAR points in a view: camera z, scene units; padding is 0.

    `places` are positions in the image, as shares of its width and height.
    """

    places: Float[Array, "k 2"]
    depths: Float[Array, " k"]


class Batch(eqx.Module):
    """One training view on the device."""

    camera: Camera  # its camera, at the resolution of `ldr`
    # the photograph, display-encoded: floats in [0, 1], or integers whose largest value is 1
    ldr: Float[Array, "h w 3"] | UInt[Array, "h w 3"]
    mask: Float[Array, "h w"] | Bool[Array, "h w"]  # 1 = use, 0 = ignore
    view_index: Int[Array, ""]  # its row in `Photometry`
    measured: Measured | None = None  # depths for the loss, or None where the loss has no such term
    # opacity of the photograph, in the type of `ldr`, which is then premultiplied by it; None: no
    # background
    alpha: Float[Array, "h w"] | UInt[Array, "h w"] | None = None
    backdrop: Float[Array, " 3"] | None = None  # display values of the background, or None
    # width and height of the photograph in the upper left of a larger canvas; None: no canvas
    size: Float[Array, " 2"] | None = None


# ------------------------------------------------------------------ host records


@dataclass(frozen=True)
class Distortion:
    """Lens distortion; a `radial` lens of all zeros is a pinhole.

    `coefficients` are OpenCV's k1, k2, p1, p2[, k3[, k4, k5, k6]] (`radial`, rational from k4 on),
    or its k1, k2, k3, k4 of the angle (`fisheye`). Other models have COLMAP's names, and
    COLMAP's parameters after the principal point.
    """

    coefficients: tuple[float, ...]
    model: LensModel = "radial"


@dataclass(frozen=True)
class View:
    """One photograph, its file and its camera."""

    name: str  # path relative to the image folder; views are sorted by it
    image_path: Path  # file with the pixels
    camera: str  # name of the physical camera ("0", "front_left")
    viewmat: Float[np.ndarray, "4 4"]  # world-to-camera, OpenCV axes
    # pinhole intrinsics of the *undistorted* image, at `width` x `height`
    K: Float32[np.ndarray, "3 3"]
    width: int  # pixels
    height: int  # pixels
    distortion: Distortion | None = None  # distortion that is removed on load, or None
    mask_path: Path | None = None  # optional mask (0 = ignore)
    exif_ev: float | None = None  # log2(time * ISO / N^2) from EXIF, up to a constant, or None
    split: Split = "train"  # `train` or `test`
    frame: int | None = None  # its number in a drive, the same for all cameras, or None
    time: float | None = None  # seconds on the clock of `Scene.objects` and `Scene.lidar`, or None
    # pixels that show the car with the camera, at any resolution; the same for all photographs of
    # a camera; None: no such pixels are known
    ego_mask: Bool[np.ndarray, "a b"] | None = None
    alpha: AlphaUse = "mask"  # meaning of its alpha channel, if it has one (`DataConfig.alpha`)


@dataclass(frozen=True)
class TrackedObject:
    """A rigid object that a data set tracks through a drive as a box."""

    name: str  # name of its track in the data set
    label: str  # its class in the data set ("Car")
    # length (x, forward), width (y, left), height (z, up) of the box, scene units
    size: tuple[float, float, float]
    times: Float64[np.ndarray, " k"]  # seconds, ascending
    # box to world at these times; the origin is the centre of the box
    poses: Float64[np.ndarray, "k 4 4"]
    moving: bool  # the object moves at some time


@dataclass(frozen=True)
class Lidar:
    """All measurements of the laser scanners of a drive.

    Points are in world coordinates at their `times`, seconds; `objects` is the row
    in `Scene.objects` of the moving object that a point lies on, -1: on none.
    """

    points: Float32[np.ndarray, "l 3"]
    times: Float64[np.ndarray, " l"]
    objects: Int[np.ndarray, " l"]


@dataclass(frozen=True)
class Tracks:
    """Observations of seed points in views, in undistorted pixels at full resolution.

    Indices are rows in `Scene.views` and `Scene.points`; pixel centres are at +0.5.
    """

    view_indices: Int[np.ndarray, " o"]
    point_indices: Int[np.ndarray, " o"]
    xy: Float32[np.ndarray, "o 2"]


@dataclass(frozen=True)
class Scene:
    """The input of a fit, as read from any format.

    Attributes:
        root: folder or JSON file that the user named.
        format: name of the format.
        views: sorted by name.
        points: seed points, scene units.
        point_colors: their display-encoded colours; None: they are sampled from photographs.
        tracks: observations of the points, or None.
        notes: messages of the reader for the user (skipped frames, unregistered images, ...).
        objects: tracked objects, moving or not.
        lidar: measurements with their times, or None.
        origin: position of our origin in the data set's world, scene units; it is near the drive,
            because float32 is coarse far away.
        split_by: source of the held-out views, in words; readers name the file if the data set has
            a split, or None.
        random_seeds: the points were drawn at random and do not lie on surfaces.
        depths: nearest and farthest camera z that the data set states, scene units, or None.
        known_response: kind of the photographs if display values are known to be light encoded as
            sRGB (`camera raw`); None: the camera's tone curve is unknown.
    """

    root: Path
    format: str
    views: tuple[View, ...]
    points: Float[np.ndarray, "p 3"]
    point_colors: UInt8[np.ndarray, "p 3"] | None
    tracks: Tracks | None = None
    notes: tuple[str, ...] = field(default_factory=tuple)
    objects: tuple[TrackedObject, ...] = ()
    lidar: Lidar | None = None
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    split_by: str | None = None
    random_seeds: bool = False
    depths: tuple[float, float] | None = None
    known_response: str | None = None

    @property
    def train_indices(self) -> tuple[int, ...]:
        """Rows of the training views."""
        return tuple(i for i, v in enumerate(self.views) if v.split == "train")

    @property
    def training_views(self) -> list[View]:
        """The views that are fitted, in order."""
        return [self.views[i] for i in self.train_indices]

    @property
    def test_indices(self) -> tuple[int, ...]:
        """Rows of the held-out views."""
        return tuple(i for i, v in enumerate(self.views) if v.split == "test")
