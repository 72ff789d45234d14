"""The pictures of a run folder: `summary.png`, `calibration.png`, and `unexplained/` of a drive."""

from __future__ import annotations

import shutil
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32

from p2gs_jax.core.atomic import atomic_write
from p2gs_jax.core.numerics import LN2
from p2gs_jax.core.text import names_as_they_are, printable
from p2gs_jax.evaluation.unexplained import WIDTH, Unexplained
from p2gs_jax.formats.frames import write_png
from p2gs_jax.photometry.response import Response, log_exposed
from p2gs_jax.photometry.solution import PhotometricSolution
from p2gs_jax.scene.pixels.store import ImageStore
from p2gs_jax.types import GAMMA_SRGB, Scene

MARKERS = "osD^vPX*"
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")

ROWS = ("photograph", "render,\nits own\nexposure", "render,\none exposure\nfor all")
# Sizes in inches, so that margins and text keep their distance whatever the photographs' shape.
LEFT, RIGHT, TOP, BOTTOM = 1.15, 0.15, 0.32, 0.5
GAP, PLOT, LEGEND_LINE = 0.06, 2.3, 0.19
TITLE_SIZE, TEXT_SIZE = 8, 8.5
# Largest mean width of a character of DejaVu Sans, in font sizes.
CHARACTER = 0.62

CHANNELS = ("red", "green", "blue")
MOST_CURVES = 12
# Letters as wide as the narrowest panel.
TITLE_LETTERS = 36

MOST_PICTURES = 6
# Smaller shares of unexplained pixels are not worth a picture.
LEAST_SHARE = 1e-3
_RED = np.array([1.0, 0.1, 0.05], np.float32)


@names_as_they_are()
def write_summary(
    path: Path,
    *,
    photographs: list[Float32[np.ndarray, "h w 3"]],
    rendered: list[Float32[np.ndarray, "h w 3"]],
    linear_tonemapped: list[Float32[np.ndarray, "h w 3"]],
    names: list[str],
    exposures_ev: Float[np.ndarray, " v"],
    cameras: list[str],
    true_ev: Float[np.ndarray, " v"] | None = None,
    exif_ev: Float[np.ndarray, " v"] | None = None,
) -> None:
    """Draw photographs, re-exposed renders, common-exposure renders, and exposures over views.

    Photographs and renders have a column for each of some views. Exposures and cameras are those of
    the training views; true ones and EXIF's are stops up to a constant, NaN where unknown.
    """
    # Imported here: it takes as long to load as a small scene to read.
    from matplotlib.figure import Figure

    columns = len(photographs)
    aspect = float(np.mean([p.shape[0] / p.shape[1] for p in photographs]))
    cell_w = max(2.0 if aspect > 1.2 else 3.0, 6.0 / columns)
    cell_h = cell_w * aspect
    width = LEFT + columns * cell_w + (columns - 1) * GAP + RIGHT
    entries = _lines(np.asarray(exposures_ev, float), cameras, true_ev, exif_ev)
    label_w = max(len(label) for *_, label in entries) * CHARACTER * TEXT_SIZE / 72 + 0.6
    per_line = max(1, int((width - LEFT - RIGHT) / label_w))
    legend_h = LEGEND_LINE * -(-sum(bool(e[-1]) for e in entries) // per_line) + 0.16
    height = TOP + 3 * (cell_h + GAP) + legend_h + PLOT + BOTTOM
    figure = Figure(figsize=(width, height), dpi=110)

    def place(left: float, top: float, w: float, h: float):
        return figure.add_axes((left / width, 1 - (top + h) / height, w / width, h / height))

    for r, images in enumerate((photographs, rendered, linear_tonemapped)):
        for c, image in enumerate(images):
            left, top = LEFT + c * (cell_w + GAP), TOP + r * (cell_h + GAP)
            axis = place(left, top, cell_w, cell_h)
            axis.imshow(np.clip(image, 0, 1), interpolation="lanczos")
            axis.set_xticks([])
            axis.set_yticks([])
            axis.set_frame_on(False)
            if r == 0:
                axis.set_title(printable(_shorten(names[c], cell_w)), fontsize=TITLE_SIZE, pad=4)
            if c == 0:
                position = ((LEFT - 0.1) / width, 1 - (top + cell_h / 2) / height)
                figure.text(*position, ROWS[r], fontsize=TEXT_SIZE, ha="right", va="center")
    top = TOP + 3 * (cell_h + GAP) + legend_h
    _plot_exposures(place(LEFT, top, width - LEFT - RIGHT, PLOT), entries, per_line)
    with atomic_write(path) as temporary:
        # Packing tighter takes longer than drawing, for a tenth of the bytes.
        figure.savefig(temporary, format="png", pil_kwargs={"compress_level": 2})


def _shorten(name: str, inches: float) -> str:
    """Return the end of a name, as much as fits."""
    room = int(inches * 72 / (CHARACTER * TITLE_SIZE))
    return name if len(name) <= room else "…" + name[1 - room :]


def _lines(exposures_ev, cameras, true_ev, exif_ev) -> list[tuple]:
    """Return (views, stops from the mean, style, label) of every line; one label per kind."""
    centered = exposures_ev - np.mean(exposures_ev)
    order = dict.fromkeys(cameras)
    owner = np.array(list(cameras))
    out = []
    for k, camera in enumerate(order):
        rows = np.flatnonzero(owner == camera)
        style = {
            "marker": MARKERS[k % len(MARKERS)],
            "color": COLORS[k % len(COLORS)],
            "markersize": 4.5,
            "linewidth": 1,
        }
        out.append((rows, centered[rows], style, f"recovered, camera {printable(camera)}"))
    for values, label, line in ((true_ev, "true", "--"), (exif_ev, "EXIF", ":")):
        if values is None:
            continue
        values = np.asarray(values, float)
        known = np.isfinite(values)
        if not known.any():
            continue
        values = values - np.mean(values[known] - centered[known])
        style = {"color": "black", "linestyle": line, "linewidth": 1.2}
        for camera in order:
            rows = np.flatnonzero((owner == camera) & known)
            if len(rows):
                lone = {"marker": "_", "markersize": 7} if len(rows) == 1 else {}
                out.append((rows, values[rows], style | lone, label))
                label = ""
    return out


def _plot_exposures(axis, entries: list[tuple], legend_columns: int) -> None:
    from matplotlib.ticker import MaxNLocator

    for rows, values, style, label in entries:
        axis.plot(rows, values, label=label or None, **style)
    axis.set_ylabel("exposure, EV\nfrom the mean", fontsize=TEXT_SIZE)
    axis.set_xlabel("training view", fontsize=TEXT_SIZE)
    axis.tick_params(labelsize=8)
    axis.xaxis.set_major_locator(MaxNLocator(integer=True, steps=[1, 2, 5, 10]))
    axis.grid(alpha=0.3)
    axis.margins(x=0.01, y=0.08)
    axis.legend(
        fontsize=TEXT_SIZE,
        ncol=legend_columns,
        loc="lower left",
        bbox_to_anchor=(0, 1.0),
        borderaxespad=0.2,
        borderpad=0,
        frameon=False,
    )


@names_as_they_are()
def write_calibration_plot(
    path: Path,
    solution: PhotometricSolution,
    *,
    cameras: list[str],
    stated_ev: Float[np.ndarray, " v"],
    pivot: float,
) -> None:
    """Draw exposures with error bars, residuals, and tone curves of a calibration.

    Stated exposures (EXIF or a file) are laid over the recovered ones, NaN where unknown; `pivot`
    is the linear value that gammas leave alone.
    """
    # Imported here: it takes as long to load as a small scene to read.
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    figure = Figure(figsize=(13, 4), layout="constrained")
    left, middle, right = figure.subplots(1, 3, width_ratios=(2.2, 1.1, 1.1))
    _plot_recovered(left, middle, solution, cameras, stated_ev)
    left.set_title("Exposure", loc="left", fontsize=10)
    left.set_ylabel("stops from the mean")
    middle.set_title("Residual of an observation", loc="left", fontsize=10)
    middle.set_ylabel("stops")
    middle.set_ylim(bottom=0)
    for axis in (left, middle):
        axis.set_xlabel("view")
        axis.xaxis.set_major_locator(MaxNLocator(integer=True))
        axis.grid(alpha=0.25)
    if len(set(cameras)) <= 12:
        left.legend(fontsize=7)
    y = np.linspace(0.02, 1, 300)
    for label, response, gamma in curves_to_draw(solution):
        base = log_exposed(y, response)[0] - np.log(pivot)
        stops = (base * gamma / GAMMA_SRGB + np.log(pivot)) / LN2
        right.plot(stops, y, lw=0.9, label=printable(label))
    right.plot(log_exposed(y, Response())[0] / LN2, y, "k--", lw=0.9, label="sRGB")
    title = textwrap.fill(f"Tone curve: {solution.response.name}", TITLE_LETTERS)
    right.set_title(title, loc="left", fontsize=10)
    right.set_xlabel("log2 of the exposed radiance (0: white)")
    right.set_ylabel("photographed value")
    right.set_xlim(-9, 1)
    right.grid(alpha=0.25)
    right.legend(fontsize=7)
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=110, format="png")


def _plot_recovered(left, middle, s: PhotometricSolution, cameras, stated_ev) -> None:
    """Draw exposures with their errors, and residuals, camera by camera."""
    seen = np.isfinite(s.exposure_errors)
    exposures_ev = np.where(seen, s.exposures_ev, np.nan)
    errors_ev = np.where(seen, s.exposure_errors_ev, np.nan)
    names = list(dict.fromkeys(cameras))
    for i, name in enumerate(names):
        mine = np.array([c == name for c in cameras])
        at = np.flatnonzero(mine)
        color, marker = COLORS[i % len(COLORS)], MARKERS[i % len(MARKERS)]
        left.errorbar(
            at,
            exposures_ev[mine],
            yerr=2 * errors_ev[mine],
            fmt=f"{marker}-",
            ms=4,
            lw=0.8,
            capsize=2,
            color=color,
            label=f"camera {printable(name)}" if len(names) > 1 else "recovered, 2 standard errors",
        )
        middle.plot(at, s.view_residual_ev[mine], marker, ms=4, color=color)
        if np.isfinite(stated_ev[mine]).any():
            label = "EXIF or file" if i == 0 else None
            left.plot(at, stated_ev[mine], "k_", ms=9, mew=1.6, label=label)


def curves_to_draw(s: PhotometricSolution) -> list[tuple[str, Response, float]]:
    """Return the tone curves to draw: name, response and gamma of each."""
    distinct = np.unique(np.round(s.gammas, 3))
    if len(s.response.parts) == 1:
        shown = distinct[:: max(1, len(distinct) // MOST_CURVES)]
        return [(f"gamma {gamma:.2f}", s.response, float(gamma)) for gamma in shown]
    names = CHANNELS if s.response.by == "channel" else [c.name for c in s.cameras]
    middle = float(np.median(s.gammas))
    shown = zip(names, s.response.parts, strict=True)
    return [(name, part, middle) for name, part in shown][:MOST_CURVES]


def write_unexplained(
    folder: Path, scene: Scene, store: ImageStore, found: Mapping[int, Unexplained]
) -> None:
    """Write photographs of a drive with the pixels marked that no static scene explains.

    They lie under the names of the views; what lies in the folder is removed.
    """
    shutil.rmtree(folder, ignore_errors=True)
    for row in worst_rows(scene, found):
        photograph, _ = store.get(row)
        shrink = max(1.0, photograph.shape[1] / (2 * WIDTH))
        size = (round(photograph.shape[1] / shrink), round(photograph.shape[0] / shrink))
        small = cv2.resize(photograph, size, interpolation=cv2.INTER_AREA)
        path = folder / Path(scene.views[row].name).with_suffix(".png")
        path.parent.mkdir(parents=True, exist_ok=True)
        write_png(path, marked(small, found[row].mask))


def worst_rows(scene: Scene, found: Mapping[int, Unexplained]) -> Sequence[int]:
    """Return views to show: the worst of each camera first, at most `MOST_PICTURES`."""
    ranked = sorted(found, key=lambda row: -found[row].share)
    ranked = [row for row in ranked if found[row].share >= LEAST_SHARE]
    first = {}
    for row in ranked:
        first.setdefault(scene.views[row].camera, row)
    leading = list(first.values())
    return [*leading, *(row for row in ranked if row not in leading)][:MOST_PICTURES]


def marked(
    photograph: Float32[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "a b"]
) -> Float32[np.ndarray, "h w 3"]:
    """Return display values with the pixels of a mask, of any size, tinted red and outlined."""
    height, width = photograph.shape[:2]
    inside = cv2.resize(mask.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST)
    rim = inside - cv2.erode(inside, np.ones((3, 3), np.uint8))
    share = np.where(rim > 0, 1.0, 0.35 * inside)[..., None].astype(np.float32)
    return photograph + share * (_RED - photograph)
