"""One LOM scene photographed in several exposures: each method fitted to the mixture.

python experiments/lom_mixtures.py LOM_SCENE... [--groups low high] [--budget-min 3]
    [--rates RATE...] --out DIR

Every view draws one of the groups of exposures (`mixtures.py`), and the views of the authors'
`transforms_test.json` are held out. All methods are fitted to this mixture for equal steps and,
with --budget-min, for equal minutes. The table has

- PSNR of held-out views against the `high` photographs with one exposure fitted to each of these,
  for all methods alike: the cameras metered every view anew (0.1 EV);
- the same under one common exposure. One transform serves all views: the mean of a method's
  parameters per view (exposure, gamma, white balance, colour correction) over the training views of
  the group `high`. No held-out or reference photograph is used;
- PSNR of held-out views as photographed: with a fitted exposure, and with everything fitted that
  the method has per view (dark photographs score high because they are dark).

With --rates, each method has the rate of corrections that is best on training views: every eighth
of them is held out in other fits, and judged like the authors' held-out views.

No photograph of these scenes may be in this project: keep --out outside of it.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from judging import common_display, configs, contact_sheet, measured, to_markdown
from mixtures import GROUPS, REFERENCE, read_groups, their_test_views, write_mixture

import p2gs_jax
from p2gs_jax.config import FitConfig
from p2gs_jax.core.atomic import write_json, write_text
from p2gs_jax.evaluation.alignment import with_fitted_exposure
from p2gs_jax.evaluation.references import load_reference
from p2gs_jax.evaluation.scores import psnr

METHODS = ("robust", "ppisp", "ppisp_solved", "3dgs", "3dgs_affine", "3dgs_bilateral")
# Contact sheet: methods shown between the photograph and the reference, and held-out views.
SHOWN, SHEET_ROWS = ("robust", "3dgs_affine"), 3
COLUMNS = (
    ("bright, exposure per view, dB", "per_view", 2),
    ("bright, one exposure, dB", "common", 2),
    ("as photographed, exposure fitted, dB", "own_exposure", 2),
    ("as photographed, all fitted, dB", "own_all", 2),
    ("steps", "steps", 0),
    ("seconds of steps", "seconds", 0),
)


# ------------------------------------------------------------------ the common exposure


def rows_of_group(run: p2gs_jax.Run, groups: dict[str, str], group: str) -> list[int]:
    """Return the rows of the training views that drew a group.

    Raises:
        SystemExit: there are none.
    """
    names = [Path(view.name).stem for view in run.scene.training_views]
    rows = [row for row, name in enumerate(names) if groups[name] == group]
    if not rows:
        raise SystemExit(f"no training view of {run.folder} is in the group {group}")
    return rows


class Common(NamedTuple):
    """Held-out views under the common exposure.

    Attributes:
        run: the fit.
        psnr: mean over them.
        per_view: the same with an exposure fitted to each bright photograph.
        pictures: display values by row of the view.
    """

    run: p2gs_jax.Run
    psnr: float
    per_view: float
    pictures: dict[int, np.ndarray]


def under_common_exposure(run: p2gs_jax.Run, groups: dict[str, str]) -> Common:
    """Render held-out views under the exposure of the reference photographs and compare."""
    scene = run.scene
    display = common_display(run, rows_of_group(run, groups, REFERENCE))
    reference = load_reference(scene.root / "reference", scene, run.cfg)
    scores, pictures = [], {}
    for index in scene.test_indices:
        linear = np.asarray(run.render(run.camera(index)).linear)
        target, (_, mask) = reference(index), run.store.get(index, 1)
        assert target is not None
        fitted = with_fitted_exposure(display(index), linear, target, mask)
        shown = [p2gs_jax.develop(linear, how) for how in (display(index), fitted)]
        scores.append([float(psnr(ldr, target, mask)) for ldr in shown])
        pictures[index] = shown[0]
    common, per_view = (float(v) for v in np.mean(scores, axis=0))
    return Common(run, common, per_view, pictures)


# ------------------------------------------------------------------ rows


def measure(
    scene: Path, out: Path, under: dict[str, FitConfig]
) -> tuple[list[dict[str, Any]], dict[str, Common]]:
    """Return the rows of all methods, fitted to a mixture, and the pictures of those that ended."""
    groups, shown = read_groups(scene), dict[str, Common]()

    def judge(method: str, run: p2gs_jax.Run, metrics: dict[str, Any]) -> dict[str, Any]:
        common = shown[method] = under_common_exposure(run, groups)
        test = metrics["test"]
        return {
            "own_exposure": test["exposure_fitted"]["psnr"],
            # There where a view has more than an exposure.
            "own_all": test.get("photometry_fitted", test["exposure_fitted"])["psnr"],
            "common": common.psnr,
            "per_view": common.per_view,
            "steps": metrics["counts"]["steps"],
            "seconds": metrics["seconds"]["optimisation"],
        }

    return measured(scene, out, under, judge), shown


def at_best_rates(
    scene: Path, out: Path, under: dict[str, FitConfig], rates: Sequence[float], theirs: list[str]
) -> tuple[dict[str, FitConfig], str]:
    """Return the methods at their best rates, and the table of all rates.

    Args:
        scene: a mixture.
        out: folder of the fits.
        under: methods.
        rates: that are tried; the best has the largest PSNR under one exposure.
        theirs: held-out views of the authors, which are neither fitted nor judged.
    """
    groups = read_groups(scene)
    views = [f"{view}.JPG" for view in groups if view not in theirs]
    held = views[::8]
    split = out.with_name(f"{out.name}.json")
    write_json(split, {"train": sorted({*views} - {*held}), "test": held})
    tried = {
        f"{m}, {rate:g}": p2gs_jax.with_fields(
            c, {"optimizer.appearance": rate, "data.split": str(split)}
        )
        for m, c in under.items()
        for rate in rates
    }
    rows, _ = measure(scene, out, tried)
    scores, best = {row["method"]: row.get("common", 0.0) for row in rows}, {}
    for method, cfg in under.items():
        rate = max(rates, key=lambda rate: scores[f"{method}, {rate:g}"])
        best[f"{method}, {rate:g}"] = p2gs_jax.with_fields(cfg, {"optimizer.appearance": rate})
    return best, to_markdown(rows, COLUMNS)


# ------------------------------------------------------------------ what is written


def write_sheet(path: Path, scene: Path, shown: dict[str, Common]) -> None:
    """Write held-out views: as photographed, under the common exposure, and the reference."""
    run, groups = next(iter(shown.values())).run, read_groups(scene)
    reference = load_reference(scene / "reference", run.scene, run.cfg)
    held = run.scene.test_indices
    picked = sorted({held[round(k)] for k in np.linspace(0, len(held) - 1, SHEET_ROWS)})
    rows = []
    for index in picked:
        name = Path(run.scene.views[index].name).stem
        columns = [("as photographed", run.photograph(index))]
        columns += [(m, c.pictures[index]) for m, c in shown.items()]
        target = reference(index)
        assert target is not None
        columns.append((f"photographed as {REFERENCE}", target))
        title = f"{scene.name}, view {name}: drew {groups[name]}; methods under the common exposure"
        rows.append((title, columns))
    contact_sheet(path, rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", type=Path, nargs="+", help="LOM scene folders")
    parser.add_argument("--out", type=Path, default=Path(tempfile.gettempdir(), "lom_mixtures"))
    parser.add_argument("--groups", nargs="+", default=list(GROUPS), choices=GROUPS)
    parser.add_argument("--methods", nargs="+", default=list(METHODS), help="presets")
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--budget-min", type=float, help="equal minutes as well")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--rates", type=float, nargs="+", help="of corrections that are tried")
    args = parser.parse_args()
    if args.out.resolve().is_relative_to(Path(__file__).resolve().parents[1]):
        raise SystemExit("--out is inside this project, where no picture of these scenes may be.")
    if REFERENCE not in args.groups:
        raise SystemExit(f"--groups needs {REFERENCE}: the common exposure is that of this group.")
    budgets: dict[str, dict[str, Any]] = {f"steps_{args.steps}": {"steps": args.steps}}
    if args.budget_min:
        budgets[f"minutes_{args.budget_min:g}"] = {"budget_s": 60 * args.budget_min}
    tables, text = {}, []
    for lom in args.scenes:
        scene = args.out / f"{lom.name}_{'_'.join(args.groups)}"
        if not scene.exists():
            write_mixture(lom, scene, args.groups, their_test_views(lom))
        for name, train in budgets.items():
            out = args.out / "runs" / scene.name / name
            under = configs(args.methods, seed=args.seed, **train)
            if args.rates:
                of_rates = out.with_name(f"{name}_rates"), under, args.rates
                under, tried = at_best_rates(scene, *of_rates, their_test_views(lom))
                text.append(f"### {scene.name}, {name}, training views at each rate\n\n{tried}")
            rows, shown = measure(scene, out, under)
            tables[f"{scene.name}/{name}"] = rows
            text.append(f"### {scene.name}, {name}\n\n{to_markdown(rows, COLUMNS)}")
            print(text[-1], flush=True)
            kept = {m: shown[m] for m in SHOWN if m in shown}
            if kept:
                write_sheet(args.out / f"{scene.name}_{name}.png", scene, kept)
    write_json(args.out / "lom_mixtures.json", tables)
    write_text(args.out / "lom_mixtures.md", "\n".join(text))


if __name__ == "__main__":
    main()
