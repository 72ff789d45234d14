"""NeRF-synthetic lego as 3DGS published it: white background, 7,000 and 30,000 steps.

python experiments/published/lego.py SCENE --out DIR [--methods 3dgs robust] [--steps 7000 30000]

    [--perturbed --width 400]

With --perturbed, training photographs but the first have the colours of NeRF in the Wild's
experiment: s rgb + b, clipped, before they are composited on white. For each channel s is drawn
from 0.8 to 1.2 and b from -0.2 to 0.2, with the number of the photograph as the seed. Held-out
views are judged under the parameters of the first photograph, as published.

The script measures one row at a time, and continues after an interruption. PSNR of the held-out
views is measured as they are, without any exposure fitted, as published. The pictures of this scene
are not for this project: keep --out outside of it.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from published_rows import HERE, Key, fitted, measure, of_fit, options

import p2gs_jax
from p2gs_jax.core.atomic import atomic_folder
from p2gs_jax.evaluation.scores import psnr

sys.path.insert(0, str(HERE.parent))

from judging import common_display

BLUR = ("--render.blur", "0.3")
# Of each method its options; `3dgs` and `robust` densify by `mcmc`.
METHODS = {
    "3dgs_published": ("--preset", "3dgs_published"),
    "3dgs": ("--preset", "3dgs"),
    "robust": ("--preset", "robust"),
    "3dgs, blur of 3DGS": ("--preset", "3dgs", *BLUR),
    "robust, blur of 3DGS": ("--preset", "robust", *BLUR),
    "3dgs, adaptive, blur of 3DGS": ("--preset", "3dgs", "--densify.method", "adaptive", *BLUR),
}
STEPS = (7_000, 30_000)
PERTURBED = ("robust", "3dgs", "3dgs_affine", "ppisp")


def perturb(lego: Path, out: Path) -> None:
    """Write the scene with perturbed training photographs."""
    with atomic_folder(out) as folder:
        shutil.copytree(lego, folder, dirs_exist_ok=True)
        photographs = sorted((folder / "train").glob("r_*.png"), key=lambda f: int(f.stem[2:]))
        for number, path in enumerate(photographs[1:], 1):
            image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            assert image is not None
            rng = np.random.RandomState(number)
            scale, offset = rng.uniform(0.8, 1.2, 3), rng.uniform(-0.2, 0.2, 3)
            rgb = np.clip(scale * (image[..., 2::-1] / 255) + offset, 0, 1)
            image[..., :3] = np.round(255 * rgb[..., ::-1])
            cv2.imwrite(str(path), image)


def under_first(run: p2gs_jax.Run) -> float:
    """Return the mean PSNR of held-out views under the parameters of the first photograph."""
    names = [Path(view.name).stem for view in run.scene.training_views]
    display, scores = common_display(run, [names.index("r_0")]), []
    for index in run.scene.test_indices:
        result = run.render(run.camera(index))
        shown = display(index)
        ldr = p2gs_jax.develop(result.linear, shown, alpha=result.alpha)
        photograph, mask = run.store.get(index)
        scores.append(float(psnr(ldr, photograph, mask)))
    return float(np.mean(scores))


def main() -> None:
    parser = options(__doc__, "lego", METHODS, STEPS)
    parser.add_argument("--perturbed", action="store_true", help="colours of NeRF in the Wild")
    parser.add_argument("--width", type=int, default=800)
    args = parser.parse_args()
    scene, benchmark, known = args.scenes[0], "lego", METHODS
    if args.perturbed:
        benchmark, known = "lego_perturbed", {m: ("--preset", m) for m in PERTURBED}
        if args.methods == list(METHODS):
            args.methods = list(PERTURBED)
        if not (args.out / "perturbed").exists():
            perturb(scene, args.out / "perturbed")
        scene = args.out / "perturbed"
    size = () if args.width == 800 else ("--max-width", str(args.width))
    of = "lego" if not size else f"lego, {args.width} px"

    def row(key: Key) -> dict[str, Any]:
        chosen = (*known[key.method], "--steps", str(key.steps), "--background", "white", *size)
        name = f"{key.method.replace(', ', '_').replace(' ', '_')}_{key.steps}"
        out = args.out / "_".join([name, *size[1:], *(["perturbed"] if args.perturbed else [])])
        fit = fitted(scene, out, chosen, args.again)
        command = f"p2gs-jax fit LEGO {' '.join(chosen)}"
        test = fit.metrics["test"]["averaged"]
        figures = {k: test[k] for k in ("psnr", "ssim", "lpips") if k in test}
        if args.perturbed:
            figures = {"psnr": under_first(p2gs_jax.load_run(out))}
            command = "python experiments/published/lego.py LEGO --perturbed"
            command += f" --width {args.width} --methods {key.method} --steps {key.steps}"
        return {"figures": figures, **of_fit(fit, command)}

    measure([Key(benchmark, of, m, s) for s in args.steps for m in args.methods], row, args.again)


if __name__ == "__main__":
    main()
