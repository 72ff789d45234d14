"""The low-light protocol of Aleth-NeRF on any LOM scene: fitted to `low`, judged against `high`.

python experiments/published/lom_low.py LOM_SCENE... --out DIR [--methods robust 3dgs luminance_gs]
    [--steps 600] [--mixed]

The authors' `transforms_test.json` lists the held-out views. They never align: their method
brightens by itself, with a degree and a gain that they chose for each scene, and PSNR is that of
the picture as rendered. Methods that do not know how bright a picture should be cannot be judged
by this. The name of each score says what the method is given:

- `unaligned`: the held-out view as the dark photographs show it; plain NeRF is published so;
- `enhanced`: the enhanced view of `luminance_gs` as rendered: the authors' protocol;
- `mean_half`: one exposure for all views that brings the mean of the training renders to half of
  the display range, without a look at any `high` photograph;
- `per_view`: one exposure for each held-out view, solved from its `high` photograph. The cameras of
  LOM metered every view anew (0.1 EV), which limits every score with one exposure for all views;
- `exposure`: one exposure for all views, solved from the `high` photographs of the training views;
- `all`: the same for exposure, gamma and white balance.

With --mixed every view draws its dark or its bright photograph, as in `lom_mixtures.py`; `common`
is the score under the mean parameters of the bright training views, beside `per_view`.

No photograph of these scenes may be in this project: keep --out outside of it.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np
from published_rows import HERE, Key, fitted, measure, of_fit, options

import p2gs_jax
from p2gs_jax.evaluation.alignment import fit_capture, with_fitted_exposure
from p2gs_jax.evaluation.references import load_reference
from p2gs_jax.evaluation.scores import psnr, ssim
from p2gs_jax.photometry.display import with_capture

sys.path.insert(0, str(HERE.parent))

from lom_mixtures import under_common_exposure
from mixtures import read_groups, their_test_views, write_mixture

METHODS = ("robust", "3dgs", "luminance_gs")
MEAN, STOPS, HALVINGS = 0.5, 12.0, 30


class Aligned:
    """How a run's views are shown, after each alignment."""

    def __init__(self, run: p2gs_jax.Run):
        """Render the training views once."""
        self.run = run
        self._usual = dataclasses.replace(run.common_display(), exposure=run.mean.exposure)
        # Renders are compared with `high` without the corrections learned from `low`.
        self._plain = dataclasses.replace(self._usual, correction=None)
        reference = load_reference(run.scene.root / "reference", run.scene, run.cfg)
        self.target = lambda row: np.asarray(reference(row))
        self._training = [
            (self.linear(row), self.target(row), run.store.get(row)[1])
            for row in run.scene.train_indices
        ]

    def linear(self, row: int) -> np.ndarray:
        """Return the radiance that a view shows."""
        return np.asarray(self.run.render(self.run.camera(row)).linear)

    def per_view(self, row: int, linear: np.ndarray) -> p2gs_jax.DisplayTransform:
        """Return the transform with the exposure fitted to one bright photograph."""
        images = linear, self.target(row), self.run.store.get(row)[1]
        return with_fitted_exposure(self._plain, *images)

    def displays(self) -> dict[str, p2gs_jax.DisplayTransform]:
        """Return the transforms of scores but `per_view`; only `luminance_gs` has `enhanced`."""
        exposed = [with_fitted_exposure(self._plain, *images) for images in self._training]
        found = [
            fit_capture(*images, start.capture, start.formation, gamma=True, white_balance=True)
            for start, images in zip(exposed, self._training, strict=True)
        ]
        taken = [with_capture(self._plain, capture) for capture in found]
        out = {"unaligned": self._usual}
        if self.run.cfg.photometry.appearance == "luminance":
            out["enhanced"] = self._plain
        out["mean_half"] = self._of_mean(MEAN)
        out["exposure"] = dataclasses.replace(
            self._plain, exposure=_middle([t.exposure for t in exposed])
        )
        balances = np.array([t.white_balance or (0.0, 0.0, 0.0) for t in taken])
        red, green, blue = np.median(balances, axis=0)
        out["all"] = dataclasses.replace(
            self._plain,
            exposure=_middle([t.exposure for t in taken]),
            gamma=_middle([t.gamma for t in taken]),
            white_balance=(float(red), float(green), float(blue)),
        )
        return out

    def _of_mean(self, level: float) -> p2gs_jax.DisplayTransform:
        low, high = -STOPS, STOPS
        for _ in range(HALVINGS):
            ev = (low + high) / 2
            shown = dataclasses.replace(self._plain, exposure=2.0**ev)
            mean = np.mean(
                [p2gs_jax.develop(x[::4, ::4], shown).mean() for x, *_ in self._training]
            )
            low, high = (ev, high) if mean < level else (low, ev)
        return dataclasses.replace(self._plain, exposure=2.0**low)


def _middle(values: Sequence[float]) -> float:
    return float(np.exp(np.median(np.log(values))))


def figures(run: p2gs_jax.Run) -> dict[str, float]:
    """Return PSNR and SSIM against `high` under each alignment, means over held-out views."""
    aligned, found = Aligned(run), dict[str, list[tuple[float, float]]]()
    displays = aligned.displays()
    for row in run.scene.test_indices:
        linear, target, mask = aligned.linear(row), aligned.target(row), run.store.get(row)[1]
        for name, display in {**displays, "per_view": aligned.per_view(row, linear)}.items():
            ldr = p2gs_jax.develop(linear, display)
            scores = (float(psnr(ldr, target, mask)), float(ssim(ldr, target, mask)))
            found.setdefault(name, []).append(scores)
    out = {}
    for name, scores in found.items():
        out[name], out[f"{name}_ssim"] = (float(v) for v in np.mean(scores, axis=0))
    return out


def figures_of_mixture(run: p2gs_jax.Run) -> dict[str, float]:
    """Return PSNR against `high`; nothing is fitted to held-out views for `common`."""
    found = under_common_exposure(run, read_groups(run.scene.root))
    return {"common": found.psnr, "per_view": found.per_view}


def main() -> None:
    parser = options(__doc__, "lom", METHODS, (600,))
    parser.add_argument("--mixed", action="store_true", help="fitted to `low` and `high` together")
    args = parser.parse_args()
    if args.out.resolve().is_relative_to(HERE.parents[1].resolve()):
        raise SystemExit("--out is inside this project, where no picture of these scenes may be.")
    folders = {lom.resolve().name.removeprefix("lom_"): lom for lom in args.scenes}
    benchmark, groups, judge = "lom_low", ["low"], figures
    if args.mixed:
        benchmark, groups, judge = "lom_mixed", ["low", "high"], figures_of_mixture

    def row(key: Key) -> dict[str, Any]:
        lom = folders[key.scene]
        scene = args.out / (f"{key.scene}_mixed" if args.mixed else key.scene)
        if not scene.exists():
            write_mixture(lom, scene, groups, their_test_views(lom))
        run = args.out / "runs" / f"{scene.name}_{key.method}_{key.steps}"
        chosen = ("--preset", key.method, "--steps", str(key.steps))
        fit = fitted(scene, run, (*chosen, "--reference", str(scene / "reference")), args.again)
        command = (
            f"python experiments/published/lom_low.py LOM_{key.scene.upper()} "
            f"{'--mixed ' if args.mixed else ''}--methods {key.method} --steps {key.steps}"
        )
        return {"figures": judge(p2gs_jax.load_run(run)), **of_fit(fit, command)}

    wanted = [Key(benchmark, n, m, s) for s in args.steps for n in folders for m in args.methods]
    measure(wanted, row, args.again)


if __name__ == "__main__":
    main()
