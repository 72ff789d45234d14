"""Display colours of a run in the files of other programs, with the error that baking leaves."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from p2gs_jax.cli.options.export import Format
from p2gs_jax.core.atomic import write_json
from p2gs_jax.core.numerics import evenly_spaced
from p2gs_jax.core.progress import Reporter
from p2gs_jax.formats.compressed_ply import read_compressed_ply, write_compressed_ply
from p2gs_jax.formats.gltf import write_gltf
from p2gs_jax.formats.ply import write_ply
from p2gs_jax.formats.splat import read_splat, write_splat
from p2gs_jax.formats.spz import read_spz, write_spz
from p2gs_jax.formats.usd import NamedCamera, write_usd
from p2gs_jax.gaussians.bake import (
    Target,
    bake,
    baking_error,
    display_comments,
    error_summary,
    refine,
    true_target,
)
from p2gs_jax.photometry.display import DisplayTransform
from p2gs_jax.render.capacity import make_renderer
from p2gs_jax.render.harmonics import MAX_DEGREE
from p2gs_jax.render.project import at_time
from p2gs_jax.run.read import Run
from p2gs_jax.scene.device import camera_of
from p2gs_jax.scene.images import ImageStore
from p2gs_jax.types import Gaussians

STEPS = 240
# The baking error is measured on at most this many views of each split, evenly spread.
MEASURED = 60


@dataclass(frozen=True)
class _Writer:
    """Writer and reader of a format with display colours.

    Attributes:
        write: the file, of these Gaussians.
        read: what a program reads; None: the numbers are those that were written.
        degree: of the harmonics that the format holds.
    """

    write: Callable[[Path, Gaussians], int]
    read: Callable[[Path], Gaussians] | None = None
    degree: int = MAX_DEGREE


WRITERS = {
    "splat": _Writer(write_splat, read_splat, 0),
    "spz": _Writer(write_spz, read_spz),
    "compressed-ply": _Writer(write_compressed_ply, read_compressed_ply),
    "gltf": _Writer(write_gltf),
}


class DisplayFiles:
    """Display colours under one display transform, baked once per degree, with their error."""

    def __init__(
        self,
        fitted: Run,
        store: ImageStore,
        transform: DisplayTransform,
        steps: int | None,
        reporter: Reporter,
    ):
        """Render the true pictures that colours are refined against.

        Args:
            fitted: the run.
            store: its photographs.
            transform: from radiance to display values.
            steps: of refinement; None: enough.
            reporter: receives progress.
        """
        self.fitted, self.transform, self.reporter = fitted, transform, reporter
        self.store = store
        self.errors: dict[int, dict] = {}
        self.gaussians, scene = at_time(fitted.as_of(), None), fitted.scene
        self.steps = max(STEPS, len(scene.train_indices)) if steps is None else steps
        self.baked: dict[int, Gaussians] = {}
        render = make_renderer(fitted.cfg.render)
        self.targets: dict[int, Target] = {}
        wanted = scene.train_indices if self.steps else _spread(scene.train_indices)
        rows = [*wanted, *_spread(scene.test_indices)]
        for done, index in enumerate(rows):
            self.targets[index] = true_target(
                scene.views[index].name,
                self.gaussians,
                camera_of(store, index),
                transform,
                render,
            )
            reporter.stage("Rendering true pictures", done + 1, len(rows))

    def write(self, name: Format, path: Path, sidecar: Path) -> str:
        """Write one format and its JSON; return sentences about it.

        Args:
            name: of the format.
            path: the file.
            sidecar: what says how it was made and how far it is from the truth.
        """
        begin = time.monotonic()
        if name == "display-ply":
            shown = self._bake(MAX_DEGREE)
            error = self._error_of_baked(MAX_DEGREE)
            comments = [
                *display_comments(self.transform),
                *(f"p2gs-jax: {t}" for t in _sentences(error)),
            ]
            write_ply(path, shown, comments)
        elif name == "usd":
            shown = self._bake(MAX_DEGREE)
            write_usd(path, shown, named_cameras(self.fitted, self.store))
            error = self._error_of_baked(MAX_DEGREE)
        else:
            writer = WRITERS[name]
            shown = self._bake(writer.degree)
            writer.write(path, shown)
            if writer.read is None:
                error = self._error_of_baked(writer.degree)
            else:
                error = self._error(writer.read(path))
        write_json(
            sidecar,
            {
                "file": path.name,
                "gaussians": self.gaussians.capacity,
                "exposure": self.transform.exposure,
                "exposure_ev_from_mean": float(
                    np.log2(self.transform.exposure / self.fitted.mean.exposure_geometric)
                ),
                "gamma": self.transform.gamma,
                "curve": self.transform.formation.curve,
                "white_balance": None
                if self.transform.white_balance is None
                else np.exp(self.transform.white_balance).tolist(),
                "bake_steps": self.steps,
                "seconds": time.monotonic() - begin,
                "baking_error": error,
            },
        )
        return "; ".join([f"{self.gaussians.capacity} Gaussians", *_sentences(error)])

    def _bake(self, degree: int) -> Gaussians:
        cfg, g = self.fitted.cfg, self.gaussians
        if degree not in self.baked:
            self.reporter.stage("Baking")
            start = bake(g, self.transform, cfg.render.radiance, degree)
            train = self.fitted.scene.train_indices
            self.baked[degree] = refine(
                start,
                [self.targets[i] for i in train if i in self.targets],
                cfg.render,
                steps=self.steps,
                seed=cfg.train.seed,
                on_step=lambda done, steps: self.reporter.stage("Baking", done, steps),
            )
        return self.baked[degree]

    def _error_of_baked(self, degree: int) -> dict:
        """Return the error of a file that holds the baked colours as they are."""
        if degree not in self.errors:
            self.errors[degree] = self._error(self._bake(degree))
        return self.errors[degree]

    def _error(self, shown: Gaussians) -> dict:
        """Return the baking error by split."""
        self.reporter.stage("Measuring")
        scene, render = self.fitted.scene, self.fitted.cfg.render
        splits = {"train": scene.train_indices, "test": scene.test_indices}
        return {
            split: error_summary(
                baking_error(shown, [self.targets[i] for i in _spread(rows)], render)
            )
            for split, rows in splits.items()
        }


def named_cameras(fitted: Run, store: ImageStore) -> list[NamedCamera]:
    """Return the cameras of all photographs at the size of the fit."""
    found = (store.camera(index) for index in range(len(fitted.scene.views)))
    return [
        NamedCamera(view.name, viewmat, K, width, height)
        for view, (viewmat, K, width, height) in zip(fitted.scene.views, found, strict=True)
    ]


def _spread(rows: Sequence[int]) -> list[int]:
    """Return at most MEASURED of the rows, evenly spread."""
    return [rows[i] for i in evenly_spaced(len(rows), MEASURED)]


def _sentences(error: dict) -> list[str]:
    """Return sentences on the baking error."""
    said = []
    for split, name in (("train", "training"), ("test", "held-out")):
        s = error[split]
        if s is not None:
            said.append(
                f"baking error over {s['views']} {name} views: median {s['psnr_median']:.2f} dB, "
                f"worst {s['psnr_worst']:.2f} dB ({s['worst_view']}), mean {s['mean_codes']:.2f} "
                f"and largest {s['max_codes']:.0f} 8-bit levels; median "
                f"{s['psnr_on_white_median']:.2f} dB over white"
            )
    return said
