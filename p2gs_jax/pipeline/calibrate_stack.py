"""Exposures and response of a stack: one fixed viewpoint, several exposures, no poses needed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from p2gs_jax.core.atomic import write_json
from p2gs_jax.core.numerics import LN2
from p2gs_jax.core.streams import Stream, generator
from p2gs_jax.errors import UserError
from p2gs_jax.photometry.agreement import compare
from p2gs_jax.photometry.observations import Observations
from p2gs_jax.photometry.response import BASES, Response, log_exposed
from p2gs_jax.photometry.solution import (
    KnownExposures,
    PhotometricSolution,
    Problem,
    fit_model,
    fit_response,
    make_problem,
)
from p2gs_jax.photometry.sources.sampling import sample
from p2gs_jax.run.calibration_plot import write_calibration_plot
from p2gs_jax.run.photometry_file import write_solution
from p2gs_jax.scene.exif import read_exif_ev
from p2gs_jax.scene.known_exposures import read_known_exposures, stated_ev
from p2gs_jax.types import View

POINTS, CANDIDATES = 4000, 40_000
MARGIN = 8
SATURATED = 250 / 255
# Above the black level by this much a value carries signal, display values.
ABOVE_BLACK = 8 / 255
# A spike below this code that holds this share of a frame is its black level.
BLACKEST, SPIKE = 40, 0.3
# Frames in which fewer pixels than this share carry signal say little.
SIGNAL = 0.15
# Shifts beyond this many pixels are mistakes of the matcher, not of the tripod.
LARGEST_SHIFT = 7
# Smooth residuals above this many stops, at equal brightness, mean local tone mapping.
LOCAL_EV = 0.075
GRID = (6, 8)
SUFFIXES = {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp"}
PIVOT = 0.18


class Stack(NamedTuple):
    """Photographs of one viewpoint.

    Attributes:
        files: the photographs.
        images: 8-bit RGB.
        valid: pixels that hold data in every frame (a pure blue border is none).
    """

    files: list[Path]
    images: list[UInt8[np.ndarray, "h w 3"]]
    valid: Bool[np.ndarray, "h w"]

    @property
    def names(self) -> list[str]:
        """File names."""
        return [p.name for p in self.files]


@dataclass(frozen=True)
class StackResult:
    """What a stack says.

    Attributes:
        views: the photographs; poses mean nothing.
        solution: exposures and common response.
        known: where known exposures came from, or None.
        stated_ev: stated exposures in stops, moved to the recovered ones; NaN where unknown.
        signal: frames in which enough points are neither black nor saturated.
        shifts: pixels by which each frame was moved to fit its neighbour.
        black: values up to here were taken as black.
        curve_ev: residual that depends on brightness, frame by frame, stops.
        local_ev: smooth residual over the image at equal brightness, stops.
        problem: the observations.
        xy: their positions.
        messages: what the user should know.
    """

    views: tuple[View, ...]
    solution: PhotometricSolution
    known: str | None
    stated_ev: Float[np.ndarray, " v"]
    signal: Bool[np.ndarray, " v"]
    shifts: Float[np.ndarray, "v 2"]
    black: float
    curve_ev: float
    local_ev: float
    problem: Problem
    xy: Float[np.ndarray, "p 2"]
    messages: tuple[str, ...]

    @property
    def names(self) -> list[str]:
        """File names."""
        return [v.name for v in self.views]

    @property
    def one_response(self) -> bool:
        """Whether one response explains the stack."""
        return self.local_ev <= LOCAL_EV


def read_stack(folder: Path) -> Stack:
    """Read the photographs of a folder (or of its `images/`).

    Raises:
        UserError: fewer than two photographs, unreadable ones, or different sizes.
    """
    if not folder.is_dir():
        raise UserError(f"{folder} is not a folder.", fix="name the folder of the photographs")
    inner = folder / "images" if (folder / "images").is_dir() else folder
    files = sorted(p for p in inner.iterdir() if p.suffix.lower() in SUFFIXES)
    if len(files) < 2:
        raise UserError(
            f"{inner} holds {len(files)} photograph(s); a stack needs two.",
            fix="name a folder of photographs from one viewpoint at several exposures",
        )
    images = []
    for path in files:
        image = cv2.imread(str(path), cv2.IMREAD_COLOR)
        if image is None:
            raise UserError(f"{path} cannot be read as an image.", fix="replace or remove it")
        if images and image.shape != images[0].shape:
            raise UserError(
                f"{path} is {image.shape[1]}x{image.shape[0]}, {files[0].name} "
                f"{images[0].shape[1]}x{images[0].shape[0]}.",
                fix="a stack has one size",
            )
        images.append(cv2.cvtColor(image, cv2.COLOR_BGR2RGB))
    blue = np.all([(i[..., 2] > 200) & (i[..., 0] < 60) & (i[..., 1] < 60) for i in images], 0)
    grown = cv2.dilate(blue.astype(np.uint8), np.ones((15, 15), np.uint8)) > 0
    return Stack(files, images, ~grown)


def align(images: list[UInt8[np.ndarray, "h w 3"]]) -> Float[np.ndarray, "v 2"]:
    """Return shifts that bring each frame onto the first, through its neighbours.

    Median threshold bitmaps do not depend on exposure; frames that are mostly black or white give
    wild values, which count as no shift.
    """
    matcher = cv2.createAlignMTB(3)
    gray = [cv2.cvtColor(i, cv2.COLOR_RGB2GRAY) for i in images]
    shifts = np.zeros((len(images), 2))
    for k in range(1, len(images)):
        step = np.array(matcher.calculateShift(gray[k - 1], gray[k]), float)
        useful = all(25 < np.median(g) < 230 for g in (gray[k - 1], gray[k]))
        if not useful or np.abs(step).max() > LARGEST_SHIFT:
            step = np.zeros(2)
        shifts[k] = shifts[k - 1] + step
    return shifts


def black_level(images: list[UInt8[np.ndarray, "h w 3"]], valid) -> float:
    """Return the value up to which the darkest frame shows nothing but its black level.

    A frame that is mostly black has a spike in its histogram there, whatever the offset (film
    scans: 13-16 of 255); one that is not is trusted down to its darkest percent.
    """
    darkest = min(images, key=lambda i: float(np.mean(i)))
    values = darkest[valid]
    level = float(np.percentile(values, 1))
    for channel in range(3):
        counts = np.bincount(values[:, channel], minlength=256)[:BLACKEST] / len(values)
        spike = int(np.argmax(counts))
        if counts[max(spike - 2, 0) : spike + 3].sum() > SPIKE:
            level = max(level, float(spike + 2))
    return level / 255 + ABOVE_BLACK


def signal_share(values: UInt8[np.ndarray, "n 3"], black: float) -> float:
    """Return the share of pixels that are neither black nor saturated in some channel."""
    return float(((values > 255 * black) & (values < 255 * SATURATED)).any(-1).mean())


def choose_points(stack: Stack, black: float, seed: int) -> Float[np.ndarray, "p 2"]:
    """Return positions, as many in the mid tones of each frame."""
    rng = generator(seed, Stream.STACK_PIXELS)
    height, width = stack.valid.shape
    x = rng.integers(MARGIN, width - MARGIN, CANDIDATES)
    y = rng.integers(MARGIN, height - MARGIN, CANDIDATES)
    keep = stack.valid[y, x]
    x, y = x[keep], y[keep]
    each = POINTS // len(stack.images)
    chosen = np.zeros(len(x), bool)
    for image in stack.images:
        level = image[y, x].max(-1) / 255
        good = np.flatnonzero((level > black + 0.1) & (level < 0.9) & ~chosen)
        chosen[rng.permutation(good)[:each]] = True
    rest = rng.permutation(np.flatnonzero(~chosen))[: max(POINTS - int(chosen.sum()), 0)]
    chosen[rest] = True
    return np.stack([x[chosen], y[chosen]], 1) + 0.5


def observe_stack(stack: Stack, xy, shifts) -> Observations:
    """Sample every frame at the same surface points."""
    frames, points = len(stack.images), len(xy)
    mask = stack.valid.astype(np.float32)
    colors, spread = [], []
    for image, shift in zip(stack.images, shifts, strict=True):
        s = sample((image / 255).astype(np.float32), mask, xy - shift)
        colors.append(np.where(s.valid[:, None], s.colors, 0))
        spread.append(0.5 * s.spread)
    return Observations(
        np.repeat(np.arange(frames), points),
        np.tile(np.arange(points), frames),
        np.concatenate(colors),
        np.concatenate(spread),
        frames,
        points,
        np.zeros(frames, int),
        names=tuple(stack.names),
    )


def unexplained(problem: Problem, residual, xy, size, signal) -> tuple[float, float]:
    """Return what one response leaves unexplained, two RMS figures in stops.

    The first depends on brightness, differently from frame to frame: tone curves that change. The
    second is what then still varies smoothly over the image: tone mapping by region.
    """
    o = problem.observations
    good = problem.usable.all(1)
    value = np.where(good, residual.mean(1), np.nan)
    cell = (xy[:, 1] * GRID[0] // size[0]) * GRID[1] + xy[:, 0] * GRID[1] // size[1]
    level = np.clip((o.colors.mean(1) * 10).astype(int), 0, 9)
    means, curves = [], []
    for frame in np.flatnonzero(signal):
        mine = np.flatnonzero((o.views == frame) & good)
        flat = value[mine].copy()
        for k in range(10):
            here = level[mine] == k
            if here.sum() > 5:
                # Near black and white only some of the values were usable: a biased choice.
                if here.sum() >= 12 and 2 <= k <= 8:
                    curves.append(np.median(flat[here]))
                flat[here] -= np.median(flat[here])
        cells = cell[o.points[mine]]
        for c in np.unique(cells):
            inside = flat[cells == c]
            if len(inside) >= 12:
                means.append(np.median(inside))
    curve, local = (
        float(np.sqrt(np.mean(np.square(v)))) / LN2 if v else 0.0 for v in (curves, means)
    )
    return curve, local


def calibrate_stack(
    folder: str | Path,
    *,
    known: str | None = None,
    known_deviation_ev: float = 0.0,
    compare_with: str | None = None,
    seed: int = 0,
) -> StackResult:
    """Solve exposures and the common response of a stack.

    Without known exposures, their logarithms are found up to a factor: exposures and response
    can be stretched together (the power gauge), which the standard curves' mid tones settle.

    Args:
        folder: photographs of one viewpoint.
        known: exposures to keep: `exif` or a CSV file; the response is then solved with them.
        known_deviation_ev: their standard deviation, stops; 0 keeps them as they are.
        compare_with: stated exposures to report beside the recovered ones; default EXIF.
        seed: of the sampled positions.

    Raises:
        UserError: see `read_stack` and `read_known_exposures`.
    """
    stack = read_stack(Path(folder))
    views = [_view(path) for path in stack.files]
    given = None
    if known is not None:
        given = KnownExposures(read_known_exposures(known, views), known_deviation_ev)
    stated = stated_ev(compare_with, views)
    shifts = align(stack.images)
    black = black_level(stack.images, stack.valid)
    xy = choose_points(stack, black, seed)
    observations = observe_stack(stack, xy, shifts)
    problem = make_problem(
        observations, black=black, saturation=SATURATED, pivot=PIVOT, known=given
    )
    solution, notes = solve_response(problem)
    signal = np.array([signal_share(i[stack.valid], black) > SIGNAL for i in stack.images])
    left = residuals(problem, solution)
    curve, local = unexplained(problem, left, xy, stack.valid.shape, signal)
    messages = [*notes, *solution.warnings]
    dark = [n for n, s in zip(stack.names, signal, strict=True) if not s]
    if dark:
        messages.append(
            f"{len(dark)} frame(s) carry little signal (black or saturated nearly everywhere): "
            f"{', '.join(dark[:6])}."
        )
    if np.abs(shifts).max() > 0:
        messages.append(f"Frames were moved by up to {np.abs(shifts).max():.0f} pixel(s).")
    if local > LOCAL_EV:
        messages.append(
            f"One response does not explain this stack: between frames, regions of equal "
            f"brightness change by {local:.2f} EV (RMS; {LOCAL_EV:g} at most for one camera "
            "pipeline). The frames were tone-mapped by region, or the light changed; do not trust "
            "the exposures."
        )
    agreement = compare(
        solution.exposures_ev,
        np.where(signal, solution.exposure_errors / LN2, np.inf),
        stated,
    )
    if agreement.views >= 2:
        messages.append(agreement.sentence("The stated exposures"))
    return StackResult(
        tuple(views),
        solution,
        known,
        stated + agreement.offset_ev,
        signal,
        shifts,
        black,
        curve,
        local,
        problem,
        xy,
        tuple(messages),
    )


def _view(path: Path) -> View:
    return View(
        path.name,
        path,
        "0",
        np.eye(4, dtype=np.float32),
        np.eye(3, dtype=np.float32),
        1,
        1,
        exif_ev=read_exif_ev(path),
    )


def write_stack(result: StackResult, out: Path) -> None:
    """Write `photometry.json`, `calibration.json` and `calibration.png`."""
    s = result.solution
    write_solution(
        out / "photometry.json",
        s,
        views=result.views,
        pivot=PIVOT,
        known=result.known,
        gauge="mean log exposure is 0; exposures and response can be stretched together",
    )
    write_json(
        out / "calibration.json",
        {
            "messages": result.messages,
            "signal": result.signal,
            "shifts": result.shifts,
            "black": result.black,
            "one_response": result.one_response,
            "local_ev": result.local_ev,
            "curve_ev": result.curve_ev,
            "residual_ev": s.residual_ev,
        },
    )
    write_calibration_plot(
        out / "calibration.png",
        s,
        cameras=[v.camera for v in result.views],
        stated_ev=result.stated_ev,
        pivot=PIVOT,
    )


def solve_response(problem: Problem) -> tuple[PhotometricSolution, list[str]]:
    """Solve exposures under the better base with its spline; a stack holds every level often."""
    bent = [fit_response(problem, Response(base)) for base in BASES]
    options = [fit_model(problem, "view_exposure", r) for r in bent if r is not None]
    if not options:
        collapsed = "A fitted response collapsed: sRGB was used as it is."
        return fit_model(problem, "view_exposure"), [collapsed]
    return min(options, key=lambda s: s.residual_ev), []


def residuals(problem: Problem, solution: PhotometricSolution) -> Float[np.ndarray, "o 3"]:
    """Return log residuals of every observation under a solution."""
    o = problem.observations
    z, _ = log_exposed(np.asarray(o.colors, np.float64), solution.response)
    level = solution.log_exposures[o.views][:, None] + solution.point_log_radiance[o.points]
    return np.where(problem.usable > 0, z - level, 0.0)


def predict(
    log_exposure: float, log_radiance: Float[np.ndarray, "p 3"], response: Response
) -> Float[np.ndarray, "p 3"]:
    """Return display values of points under an exposure."""
    y = np.linspace(1 / 510, 1, 4096)
    z = np.maximum.accumulate(log_exposed(y, response)[0])
    return np.interp(log_exposure + log_radiance, z, y)
