"""A trainer that is not ours, on photographs as they are and developed by `calibrate --develop`.

python experiments/developed.py --opensplat PROGRAM --out DIR [--spreads 0 4 8] [--lom LOM_SCENE...]
    [--steps 2000]

OpenSplat (github.com/WebODM/OpenSplat, run as a program) is trained for equal steps. Held-out
photographs of one exposure judge its splats: those of a town at ISO 8, or those of the group `high`
of a LOM mixture. `--spreads` are the ranges of the town's exposures in stops
(`exposure_spread.py`). One exposure for all views is fitted first. No photograph of LOM may be in
this project: keep --out outside of it.
"""

from __future__ import annotations

import argparse
import dataclasses
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pycolmap
from exposure_spread import sensor
from judging import contact_sheet
from mixtures import their_test_views, write_mixture
from sensor_town import town

import p2gs_jax
from p2gs_jax.config import FitConfig, PhotometryConfig
from p2gs_jax.core.numerics import srgb_decode
from p2gs_jax.evaluation.alignment import with_fitted_exposure
from p2gs_jax.evaluation.references import load_reference
from p2gs_jax.evaluation.scores import psnr
from p2gs_jax.formats.splats import read_splats
from p2gs_jax.gaussians.bake import viewer_config
from p2gs_jax.photometry.display import DisplayTransform
from p2gs_jax.render.capacity import make_renderer
from p2gs_jax.scene import load_scene
from p2gs_jax.scene.pixels.store import ImageStore, camera_of
from p2gs_jax.types import GAMMA_SRGB

TOWN = argparse.Namespace(width=240, frames=20, points=8000, seed=0)


def without(scene: Path, held_out: set[str], out: Path) -> Path:
    """Copy a COLMAP scene; the model of the copy lacks the held-out views."""
    if not out.exists():
        model = pycolmap.Reconstruction(scene / "sparse" / "0")
        for image in list(model.images.values()):
            if image.name in held_out:
                model.deregister_frame(image.frame_id)
        (out / "sparse" / "0").mkdir(parents=True)
        model.write(out / "sparse" / "0")
        shutil.copytree(scene / "images", out / "images")
    return out


def trained(program: Path, scene: Path, steps: int) -> Path:
    """Return the PLY of OpenSplat, which is trained if there is none."""
    ply = scene / f"splats_{steps}.ply"
    if not ply.exists():
        words = [program, scene, "--cpu", "-n", str(steps), "-o", ply]
        subprocess.run(words, check=True, stdout=sys.stderr)
    return ply


class Judge:
    """Held-out views of a scene, and their photographs of one exposure."""

    def __init__(self, folder: Path):
        """Read the scene."""
        cfg = FitConfig()
        self.scene = load_scene(folder, cfg.data)
        self.store = ImageStore(self.scene.views, cfg.data)
        self.rows = self.scene.test_indices
        reference = load_reference(folder / "reference", self.scene, cfg)
        self.targets = [np.asarray(reference(row)) for row in self.rows]
        self.masks = [self.store.get(row)[1] for row in self.rows]
        self.render = make_renderer(viewer_config(cfg.render))
        self.shown = DisplayTransform(1.0, GAMMA_SRGB, PhotometryConfig(curve="srgb"))

    def __call__(self, ply: Path) -> tuple[float, list[np.ndarray]]:
        """Return the PSNR of splats under one fitted exposure, and the pictures."""
        splats = read_splats(ply)
        alive = np.ones(splats.capacity, bool)
        pictures = [self.render(splats, alive, camera_of(self.store, r)).linear for r in self.rows]
        lights = [np.asarray(srgb_decode(np.clip(p, 0, 1))) for p in pictures]
        views = list(zip(lights, self.targets, self.masks, strict=True))
        found = [with_fitted_exposure(self.shown, *view).exposure for view in views]
        exposure = float(np.exp(np.median(np.log(found))))
        shown = dataclasses.replace(self.shown, exposure=exposure)
        out = [p2gs_jax.develop(light, shown) for light in lights]
        scores = [psnr(a, b, m) for a, b, m in zip(out, self.targets, self.masks, strict=True)]
        return float(np.mean(scores)), out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--opensplat", type=Path, required=True, help="its program")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--spreads", nargs="*", type=float, default=[0.0, 4.0, 8.0], help="stops")
    parser.add_argument("--lom", nargs="*", type=Path, default=[], help="LOM scene folders")
    parser.add_argument("--steps", type=int, default=2000)
    args = parser.parse_args()
    scenes = {
        f"town, {s:g} stops": town(args.out / f"town_{s:g}", sensor(s), TOWN) for s in args.spreads
    }
    for lom in args.lom:
        folder = args.out / lom.name
        if not folder.exists():
            write_mixture(lom, folder, test=their_test_views(lom))
        scenes[f"{lom.name}, mixture"] = folder
    print("| scene | as photographed, dB | developed, dB |\n|---|---|---|", flush=True)
    for name, folder in scenes.items():
        out = folder.with_name(f"{folder.name}_calibrated")
        words = ["calibrate", str(folder), "--out", str(out), "--develop", "8bit"]
        command = [sys.executable, "-m", "p2gs_jax.cli", *words]
        subprocess.run(command, check=True, stdout=sys.stderr)
        judge = Judge(folder)
        held_out = {judge.scene.views[row].name for row in judge.rows}
        shown = {}
        for kind, source in (("raw", folder), ("developed", out / "developed")):
            copy = without(source, held_out, folder.with_name(f"{folder.name}_{kind}"))
            shown[kind] = judge(trained(args.opensplat, copy, args.steps))
        scores = " | ".join(f"{score:.2f}" for score, _ in shown.values())
        print(f"| {name} | {scores} |", flush=True)
        columns = [(kind, pictures[0]) for kind, (_, pictures) in shown.items()]
        columns.append(("photograph of one exposure", judge.targets[0]))
        contact_sheet(args.out / f"{folder.name}.png", [(name, columns)])


if __name__ == "__main__":
    main()
