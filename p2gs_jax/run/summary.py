"""`summary.png`: the one picture that tells whether a fit worked."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32

from p2gs_jax.core.atomic import atomic_write
from p2gs_jax.core.drawn_names import names_as_they_are
from p2gs_jax.core.printable import printable

ROWS = ("photograph", "render,\nits own\nexposure", "render,\none exposure\nfor all")
MARKERS = "osD^vPX*"
# Sizes in inches, so that margins and text keep their distance whatever the photographs' shape.
LEFT, RIGHT, TOP, BOTTOM = 1.15, 0.15, 0.32, 0.5
GAP, PLOT, LEGEND_LINE = 0.06, 2.3, 0.19
TITLE_SIZE, TEXT_SIZE = 8, 8.5
# Largest mean width of a character of DejaVu Sans, in font sizes.
CHARACTER = 0.62
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")


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

    Args:
        path: the PNG.
        photographs: one per column.
        rendered: the same views with their own exposure.
        linear_tonemapped: the same views under one exposure.
        names: of the columns.
        exposures_ev: recovered, per training view, in stops.
        cameras: physical camera of each training view.
        true_ev: truth in stops up to a constant, NaN where it is not known.
        exif_ev: from EXIF, likewise.
    """
    # Imported here: it takes as long to load as a small scene to read.
    from matplotlib.figure import Figure

    columns = len(photographs)
    aspect = float(np.mean([p.shape[0] / p.shape[1] for p in photographs]))
    cell_w = max(2.0 if aspect > 1.2 else 3.0, 6.0 / columns)
    cell_h = cell_w * aspect
    width = LEFT + columns * cell_w + (columns - 1) * GAP + RIGHT
    entries = _curves(np.asarray(exposures_ev, float), cameras, true_ev, exif_ev)
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


def _curves(exposures_ev, cameras, true_ev, exif_ev) -> list[tuple]:
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
