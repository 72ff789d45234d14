"""Shared by comparisons with learned cameras: fits, a display for held-out views, their results.

Methods keep what cameras do to the light in different places: `Photometry` and the configuration
(ours), a matrix or grid per view (3dgs_affine, 3dgs_bilateral), or PPISP's own parameters.
"""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
from jaxtyping import Float
from PIL import Image, ImageDraw, ImageFont
from towns import table, titles

import p2gs_jax
from p2gs_jax.config import FitConfig
from p2gs_jax.core.numerics import LN2
from p2gs_jax.formats.frames import to_uint8, write_png
from p2gs_jax.photometry.luminance import Luminance
from p2gs_jax.photometry.ppisp import Ppisp, falloff, recolored

# Grey to which a colour correction is applied where it is not a factor per channel.
GREY = 0.18


def configs(names: Sequence[str], **train: Any) -> dict[str, FitConfig]:
    """Return presets under a budget; those that this version has not are named on stderr."""
    found = {}
    for name in names:
        try:
            cfg = p2gs_jax.preset(name)  # pyright: ignore[reportArgumentType]
        except p2gs_jax.UserError as error:
            print(f"{name} is skipped: {error}", file=sys.stderr, flush=True)
            continue
        found[name] = dataclasses.replace(cfg, train=dataclasses.replace(cfg.train, **train))
    return found


def measured(
    scene: Path,
    out: Path,
    under: dict[str, FitConfig],
    judge: Callable[[str, p2gs_jax.Run, dict[str, Any]], dict[str, Any]],
) -> list[dict[str, Any]]:
    """Fit all methods to a scene and judge them; finished fits are kept.

    Args:
        scene: photographs of one exposure, if there are any, are in its folder `reference`.
        judge: returns the cells of a method, from its name, its run and its `metrics.json`.

    Returns:
        A row of each method; of one that failed, why.
    """
    reference = scene / "reference"
    result = p2gs_jax.sweep(
        scene,
        out,
        under,
        reference=reference if reference.is_dir() else None,
        report=lambda line: print(f"{scene.name} {line}", file=sys.stderr, flush=True),
    )
    rows = []
    for found in result.rows:
        name = found["name"]
        if found["status"] != "done":
            rows.append({"method": name, "failed": found["reason"]})
            continue
        folder = Path(found["run"])
        metrics = json.loads((folder / "metrics.json").read_text())
        rows.append({"method": name, **judge(name, p2gs_jax.load_run(folder), metrics)})
    return rows


def to_markdown(rows: Sequence[dict[str, Any]], columns: Sequence[tuple[str, str, int]]) -> str:
    """Return a table of the rows of `measured`; a cell without a value is empty."""
    lines = []
    for row in rows:
        values = [(row.get(key), digits) for _, key, digits in columns]
        cells = ["" if value is None else f"{value:.{digits}f}" for value, digits in values]
        if "failed" in row:
            cells = [f"failed: {row['failed']}", *[""] * (len(columns) - 1)]
        lines.append([row["method"], *cells])
    return table(("method", *titles(columns)), lines)


def contact_sheet(path: Path, rows: Sequence[tuple[str, Sequence[tuple[str, np.ndarray]]]]) -> None:
    """Write rows of pictures of one size to a PNG file.

    A row is a title and its pictures; a picture is a name and display values.
    """
    file, parts = Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf", []
    for title, columns in rows:
        image = np.concatenate([picture for _, picture in columns], axis=1)
        font = ImageFont.truetype(file, max(11, image.shape[1] // 75))
        size = image.shape[1], round(1.7 * font.size)
        head, foot = (Image.new("RGB", size, "white") for _ in range(2))
        ImageDraw.Draw(head).text((2, size[1] / 2), title, "black", font, anchor="lm")
        for k, (name, picture) in enumerate(columns):
            middle = (k + 0.5) * picture.shape[1], size[1] / 2
            ImageDraw.Draw(foot).text(middle, name, "gray", font, anchor="mm")
        parts += [np.asarray(head), to_uint8(image), np.asarray(foot)]
    write_png(path, np.concatenate(parts).astype(np.float32) / 255)


def mean_of_rows(run: p2gs_jax.Run, rows: Sequence[int]) -> p2gs_jax.Run:
    """Return a run all of whose training views have the mean parameters of some of them.

    Args:
        run: the run.
        rows: of the training views that are averaged: exposures as logarithms, where the run has
            them so.
    """
    taken = jnp.asarray(rows)

    def mean(values):
        return jnp.broadcast_to(jnp.asarray(values)[taken].mean(0), np.shape(values))

    photometry, appearance = jax.tree.map(mean, run.params.photometry), run.params.appearance
    if isinstance(appearance, Ppisp):
        # All else is the cameras'.
        per_view = {k: mean(getattr(appearance, k)) for k in ("exposures", "colors")}
        appearance = dataclasses.replace(appearance, **per_view)
    elif isinstance(appearance, Luminance):
        # The curve of mean statistics stands for the mean curve.
        per_view = {k: mean(getattr(appearance, k)) for k in ("axes", "statistics")}
        appearance = dataclasses.replace(appearance, **per_view)
    elif appearance is not None:
        appearance = mean(appearance)
    params = dataclasses.replace(run.params, photometry=photometry, appearance=appearance)
    return dataclasses.replace(run, params=params)


def common_display(
    run: p2gs_jax.Run, rows: Sequence[int]
) -> Callable[[int], p2gs_jax.DisplayTransform]:
    """Return how any view is shown under the mean parameters of some training views."""
    averaged, views = mean_of_rows(run, rows), run.scene.views
    of_camera = {views[i].camera: i for i in reversed(run.scene.train_indices)}
    return lambda index: averaged.own_display(of_camera[views[index].camera])


class Found(NamedTuple):
    """The cameras as a method found them; None for parts that it does not have.

    Attributes:
        exposures_ev: of every training view.
        balance_ev: of red, green and blue beside the exposure.
        corners: share of the light that reaches the corners of each camera's images.
    """

    exposures_ev: Float[np.ndarray, " v"] | None
    balance_ev: Float[np.ndarray, "v 3"] | None
    corners: dict[str, float] | None


def found_by(run: p2gs_jax.Run) -> Found:
    """Return the exposures, white balances and vignetting of a run."""
    appearance = run.params.appearance
    if isinstance(appearance, Ppisp):
        return _found_by_ppisp(run, appearance)
    p, cameras = run.params.photometry, run.cfg.photometry.cameras
    exposures = np.log2(np.asarray(p.exposures, np.float64))
    if appearance is not None or run.cfg.photometry.curve == "linear":
        varies = np.ptp(exposures) > 0
        return Found(exposures if varies else None, None, None)
    balance = p.white_balance
    zeros = np.zeros((len(exposures), 3))
    corners = {view.camera: 1.0 for view in run.scene.views}
    corners |= {
        c.name: float(np.exp(np.sum(c.vignetting, 1)).mean()) for c in cameras if c.vignetting
    }
    return Found(exposures, zeros if balance is None else np.asarray(balance) / LN2, corners)


def _found_by_ppisp(run: p2gs_jax.Run, learned: Ppisp) -> Found:
    """Return PPISP's parameters; its colour correction as the factors that it has on grey."""
    grey = jnp.full(3, GREY)
    colored = jax.vmap(lambda color: recolored(grey, color))(jnp.asarray(learned.colors))
    stops = np.log2(np.maximum(np.asarray(colored), 1e-6) / GREY)
    mean = stops.mean(1, keepdims=True)
    corners = {}
    for name, parameters in zip(learned.names, learned.vignettings, strict=True):
        view = next(v for v in run.scene.views if v.camera == name)
        light = np.asarray(falloff(jnp.asarray(parameters), view.height, view.width))
        corners[name] = float(light[[0, 0, -1, -1], [0, -1, 0, -1]].mean())
    # A finished run has its exposures where all others have theirs (`exposures_apart`).
    apart = np.log2(np.asarray(run.params.photometry.exposures, np.float64))
    exposures = apart + np.asarray(learned.exposures, np.float64) + mean[:, 0]
    return Found(exposures, stops - mean, corners)
