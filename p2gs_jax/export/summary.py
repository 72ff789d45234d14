"""`summary.png`: the one picture that tells whether a fit worked."""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Float, Float32

from p2gs_jax.export.atomic import atomic_write

ROWS = ("photograph", "render,\nits own\nexposure", "render,\none exposure\nfor all")
MARKERS = "osD^vPX*"
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")


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
        true_ev: truth, where it is known.
        exif_ev: from EXIF, where it is complete.
    """
    columns = len(photographs)
    aspect = float(np.mean([p.shape[0] / p.shape[1] for p in photographs]))
    cell = 3.0 if aspect < 1.2 else 2.0
    figure = plt.figure(figsize=(cell * columns + 0.9, 3 * cell * aspect + 3.4), dpi=110)
    grid = figure.add_gridspec(
        4,
        columns,
        height_ratios=[cell * aspect] * 3 + [2.4],
        hspace=0.06,
        wspace=0.03,
        left=0.11 if columns > 2 else 0.16,
        right=0.985,
        top=0.955,
        bottom=0.075,
    )
    for r, images in enumerate((photographs, rendered, linear_tonemapped)):
        for c, image in enumerate(images):
            axis = figure.add_subplot(grid[r, c])
            axis.imshow(np.clip(image, 0, 1), interpolation="lanczos")
            axis.set_xticks([])
            axis.set_yticks([])
            axis.set_frame_on(False)
            if r == 0:
                axis.set_title(names[c], fontsize=8)
            if c == 0:
                axis.set_ylabel(ROWS[r], fontsize=8, rotation=0, ha="right", va="center")
    axis = figure.add_subplot(grid[3, :])
    _plot_exposures(axis, exposures_ev, cameras, true_ev, exif_ev)
    with atomic_write(path) as temporary:
        figure.savefig(temporary)
    plt.close(figure)


def _plot_exposures(axis, exposures_ev, cameras, true_ev, exif_ev) -> None:
    centered = np.asarray(exposures_ev) - np.mean(exposures_ev)
    where = np.arange(len(centered))
    for k, camera in enumerate(dict.fromkeys(cameras)):
        rows = np.array([c == camera for c in cameras])
        axis.plot(
            where[rows],
            centered[rows],
            MARKERS[k % len(MARKERS)] + "-",
            color=COLORS[k % len(COLORS)],
            markersize=4.5,
            linewidth=1,
            label=f"recovered, camera {camera}",
        )
    for values, label, style in ((true_ev, "true", "k--"), (exif_ev, "EXIF", "k:")):
        if values is None:
            continue
        values = np.asarray(values) - np.mean(values)
        for k, camera in enumerate(dict.fromkeys(cameras)):
            rows = np.array([c == camera for c in cameras])
            axis.plot(
                where[rows], values[rows], style, linewidth=1.2, label=label if k == 0 else None
            )
    axis.set_ylabel("exposure, EV\nfrom the mean", fontsize=9)
    axis.set_xlabel("training view", fontsize=9)
    axis.tick_params(labelsize=8)
    axis.grid(alpha=0.3)
    axis.margins(x=0.01, y=0.15)
    axis.legend(fontsize=8, ncol=4, loc="best", framealpha=0.85)
