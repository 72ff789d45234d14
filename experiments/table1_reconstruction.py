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
    EV_ERROR,
    ISO8,
    METHODS,
    NOT_BUILT,
    WIDE,
    Column,
    Runs,
    fit_all,
    methods,
    number,
    options,
    table,
    titles,
    write,
)

from p2gs_jax.render.capacity import make_renderer
from p2gs_jax.run.read import load_run
from p2gs_jax.scene.device import camera_of
from p2gs_jax.scene.images import ImageStore

# Table 1 of the paper (Waymo): FPS on its GPU, SSIM, PSNR, HIS, Std-Luminance.
PAPER = {
    "3DGS": "146 / .928 / 33.62 / .102 / .041",
    "3DGS + AT": "145 / .927 / 31.45 / .097 / .035",
    "Luminance-GS": "- / .863 / 17.68 / .497 / .047",
    "P2GS as printed": "90 / .939 / 31.02 / .092 / .034",
}
QUALITY: tuple[Column, ...] = (
    ("own PSNR", ("train", "psnr"), 2),
    ("mean SSIM", ("train", "averaged", "ssim"), 3),
    ("mean PSNR", ("train", "averaged", "psnr"), 2),
    ("mean LPIPS", ("train", "averaged", "lpips"), 3),
    ("ISO 8 SSIM", (*ISO8, "train", "ssim"), 3),
    ("ISO 8 PSNR", (*ISO8, "train", "psnr"), 2),
    ("ISO 8 LPIPS", (*ISO8, "train", "lpips"), 3),
)
STEADINESS = {
    "his_paper": "HIS printed",
    "his": "HIS",
    "std_luminance": "Std-L printed",
    "std_luminance_relative": "Std-L",
}
TIMED_VIEWS = 12


def frames_per_second(run) -> float:
    """Return 1 / the median time to render a view of a finished run, depth included."""
    loaded = load_run(run)
    store = ImageStore(loaded.scene.views, loaded.cfg.data)
    render = make_renderer(loaded.cfg.render)
    alive = jnp.ones(loaded.params.gaussians.capacity, bool)
    cameras = [camera_of(store, i) for i in range(min(TIMED_VIEWS, len(loaded.scene.views)))]
    seconds = []
    for camera in [cameras[0], *cameras]:
        begin = time.perf_counter()
        render(loaded.params.gaussians, alive, camera).linear.block_until_ready()
        seconds.append(time.perf_counter() - begin)
    return 1.0 / float(np.median(seconds[1:]))


def steadiness(of: str) -> tuple[Column, ...]:
    """Return the columns of STEADINESS, of the `averaged` renders or of the `photographs`."""
    return tuple((title, ("consistency", of, key), 3) for key, title in STEADINESS.items())


COLUMNS = (*QUALITY, *steadiness("averaged"))
HEADER = (
    "method",
    "FPS",
    *titles(COLUMNS),
    EV_ERROR[0],
    "paper (Waymo): FPS / SSIM / PSNR / HIS / Std-L",
)


def rows(runs: Runs, fps: dict[str, float]) -> list[list[str]]:
    photographs = runs.cells("3DGS", WIDE, steadiness("photographs"))
    blank = [""] * (1 + len(QUALITY))
    return [
        ["photographs", *blank, *photographs, "", ".096 / .041 (HIS / Std)"],
        *(
            [
                name,
                number(fps.get(name, float("nan")), 0),
                *runs.cells(name, WIDE, COLUMNS),
                runs.ev_error(name, WIDE),
                PAPER.get(name, ""),
            ]
            for name in METHODS
        ),
    ]


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
