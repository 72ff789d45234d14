"""`eval`: scores of a finished run, also beside other programs."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from p2gs_jax.cli.shared import RunPath, SceneFolder

if TYPE_CHECKING:
    from p2gs_jax.evaluation.evaluate import Judge
    from p2gs_jax.evaluation.renders_of_others import OtherRenders

# Names of folders that do not name a program.
COMMON = re.compile(r"renders|rgb|test|ours_\d+|\.")
# Keys that `evaluate` writes only if a view has the problem; old values are dropped.
UNJUDGED = ("hidden", "exposures_unknown")


@dataclass(frozen=True)
class Eval:
    """Evaluate a finished run again, against a reference or beside other programs.

    p2gs-jax eval runs/castle --reference castle/iso8
    p2gs-jax eval runs/castle --against gaussian-splatting/output/castle/test/ours_30000/renders
    """

    run: RunPath
    scene: SceneFolder = None
    reference: Path | None = None
    """Photographs of the same views under one common exposure."""
    against: tuple[Path, ...] = ()
    """Folders of renders of the held-out views by other programs (docs/report.md)."""
    lpips_weights: str | None = None
    """Weights of LPIPS: alex, vgg, or none (default: the run's weights)."""

    def execute(self) -> int:
        """Evaluate the run and rewrite its metrics; options replace the run's options."""
        from p2gs_jax.cli.tables import print_against, print_metrics
        from p2gs_jax.core.atomic import write_json
        from p2gs_jax.core.progress import PlainConsole, TerminalReporter
        from p2gs_jax.evaluation.against import check_renders
        from p2gs_jax.evaluation.evaluate import Judge, evaluate
        from p2gs_jax.evaluation.lpips import read_lpips_weights
        from p2gs_jax.evaluation.references import find_radiance, load_reference
        from p2gs_jax.evaluation.renders_of_others import find_renders
        from p2gs_jax.render.capacity import make_renderer
        from p2gs_jax.run.folder import RunFolder, require_free
        from p2gs_jax.run.photometry_files import write_metering
        from p2gs_jax.run.read import load_run, require_as_begun

        require_free(self.run)
        fitted = load_run(self.run, self.scene)
        fitted.require_photographs()
        scene, store, cfg, folder = fitted.scene, fitted.store, fitted.cfg, RunFolder(self.run)
        require_as_begun(self.run, scene, cfg)
        name = self.lpips_weights or cfg.evaluation.lpips_weights
        weights = None if name in (None, "none") else read_lpips_weights(name)
        if weights is not None:
            weights.require_sizes(scene.views, cfg.data.max_width)
        reference = self.reference or fitted.reference
        truth = None if reference is None else load_reference(reference, scene, cfg)
        others = {
            label: check_renders(find_renders(place, scene), store)
            for label, place in _labelled(self.against).items()
        }
        with TerminalReporter() as reporter:
            found = evaluate(
                fitted.params,
                scene,
                store,
                cfg,
                render=make_renderer(cfg.render, fitted.owner, store.sizes),
                reference=truth,
                radiance=find_radiance(scene, store),
                lpips_weights=weights,
                on_progress=lambda done, count: reporter.stage("Evaluating", done, count),
            )
            metrics = found.metrics
            write_metering(folder.metering, found.metering)
            judge = Judge(scene, store, fitted.params, cfg, weights, truth)
            beside = _judged(
                others, judge, metrics, lambda done, count: reporter.stage("Judging", done, count)
            )
        metrics = _kept(folder.metrics) | metrics
        write_json(folder.metrics, metrics)
        print_metrics(metrics)
        PlainConsole().print(f"Results: {folder.metrics}", soft_wrap=True)
        if others:
            write_json(folder.against, beside)
            remarks = [renders.remark for renders in others.values() if renders.remark]
            print_against(beside, self.run, metrics, remarks, folder.against)
        return 0


def _labelled(folders: tuple[Path, ...]) -> dict[str, Path]:
    """Return the folders by program; by their paths if two programs have the same name."""
    labels = []
    for folder in folders:
        names = [n for n in folder.resolve().parts if not COMMON.fullmatch(n)]
        labels.append(names[-1] if names else str(folder))
    unique = len(set(labels)) == len(labels)
    return dict(zip(labels if unique else map(str, folders), folders, strict=True))


def _judged(
    others: dict[str, OtherRenders],
    judge: Judge,
    metrics: dict[str, Any],
    on_progress: Callable[[int, int], None],
) -> dict[str, Any]:
    from p2gs_jax.evaluation.against import judge_renders, scores_of_run

    programs = {}
    for label, renders in others.items():
        names = [judge.scene.views[row].name for row in sorted(renders.files)]
        programs[label] = {
            "folder": str(renders.folder),
            "layout": renders.layout,
            "views": len(names),
            "missing": list(renders.missing),
            **judge_renders(renders, judge, on_progress),
            "run": scores_of_run(metrics, names),
        }
    return {"version": 1, "programs": programs}


def _kept(path: Path) -> dict[str, Any]:
    """Return the metrics in the file, which include scores of earlier references."""
    from p2gs_jax.core.text import parse_json

    try:
        old = parse_json(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return {k: v for k, v in old.items() if k not in UNJUDGED}
