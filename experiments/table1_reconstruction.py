"""Table 1: how well each method reconstructs its training views, and how steady it is.

python experiments/table1_reconstruction.py [--quick]

On ISO std 4. `own`: every view with the exposure and correction that the method gave it; `mean`:
all views with the mean parameters (paper); `ISO 8`: against photographs at one common exposure. HIS
and Std-Luminance are those of the renders with mean parameters, as printed and corrected (see
docs/files.md); the photographs' own are the first row. FPS are measured when the table is made.
"""

from __future__ import annotations

import time

import jax.numpy as jnp
import numpy as np
from towns import (
    METHODS,
    NOT_BUILT,
    WIDE,
    Runs,
    fit_all,
    methods,
    number,
    options,
    table,
    write,
)

from p2gs_jax.render.host import make_renderer
from p2gs_jax.run_folder import load_run
from p2gs_jax.scene.device import camera_of
from p2gs_jax.scene.images import ImageStore

# Table 1 of the paper (Waymo): FPS on its GPU, SSIM, PSNR, HIS, Std-Luminance.
PAPER = {
    "3DGS": "146 / .928 / 33.62 / .102 / .041",
    "3DGS + AT": "145 / .927 / 31.45 / .097 / .035",
    "3DGS + curve (as Luminance-GS)": "- / .863 / 17.68 / .497 / .047",
    "P2GS as printed": "90 / .939 / 31.02 / .092 / .034",
}
STEADINESS = ("his_paper", "his", "std_luminance", "std_luminance_relative")
TIMED_VIEWS = 12


def frames_per_second(run) -> float:
    """Return 1 / the median time to render a view of a finished run, depth included."""
    loaded = load_run(run)
    store = ImageStore(loaded.scene.views, loaded.cfg.data)
    render = make_renderer(loaded.cfg.render)
    alive = jnp.ones(loaded.params.gaussians.capacity, bool)
    cameras = [camera_of(store, i) for i in range(len(loaded.scene.views))]
    seconds = []
    for camera in [cameras[0], *cameras[:TIMED_VIEWS]]:
        begin = time.perf_counter()
        render(loaded.params.gaussians, alive, camera).linear.block_until_ready()
        seconds.append(time.perf_counter() - begin)
    return 1.0 / float(np.median(seconds[1:]))


def rows(runs: Runs, fps: dict[str, float]) -> list[list[str]]:
    photographs = [
        number(runs.mean("3DGS", WIDE, "consistency", "photographs", s), 3) for s in STEADINESS
    ]
    out = [["photographs", *[""] * 8, *photographs, "", ".096 / .041 (HIS / Std)"]]
    for name in METHODS:

        def cell(*path: str, digits: int = 2, name=name) -> str:
            return number(runs.mean(name, WIDE, *path), digits)

        out.append(
            [
                name,
                number(fps.get(name, float("nan")), 0),
                cell("train", "psnr"),
                cell("train", "averaged", "ssim", digits=3),
                cell("train", "averaged", "psnr"),
                cell("train", "averaged", "lpips", digits=3),
                cell("reference", "scale_aligned", "train", "ssim", digits=3),
                cell("reference", "scale_aligned", "train", "psnr"),
                cell("reference", "scale_aligned", "train", "lpips", digits=3),
                *(cell("consistency", "averaged", s, digits=3) for s in STEADINESS),
                cell("ev", digits=4) if name[0] in "Pr" else "",
                PAPER.get(name, ""),
            ]
        )
    return out


HEADER = (
    "method",
    "FPS",
    "own PSNR",
    "mean SSIM",
    "mean PSNR",
    "mean LPIPS",
    "ISO 8 SSIM",
    "ISO 8 PSNR",
    "ISO 8 LPIPS",
    "HIS printed",
    "HIS",
    "Std-L printed",
    "Std-L",
    "EV error",
    "paper (Waymo): FPS / SSIM / PSNR / HIS / Std-L",
)


def main() -> None:
    o = options(__doc__, "table1_reconstruction")
    begin = time.monotonic()
    runs = fit_all(o, {WIDE: methods()})
    first = o.protocol.towns[0]
    fps = {m: frames_per_second(f) for (m, _, t), f in runs.folders.items() if t == first}
    text = table(HEADER, rows(runs, fps)) + "\n" + NOT_BUILT + "\n"
    write(o, "table1_reconstruction", text, runs, begin, {"fps": fps})


if __name__ == "__main__":
    main()
