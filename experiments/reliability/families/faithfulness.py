"""What rounding does to a fit: float32 against float64, last bits, orders of sums, vectors."""

from __future__ import annotations

import dataclasses
import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from reliability.families._float64 import GROUPS, Gaps, compare
from reliability.families._seeds import Scores, scores_under
from reliability.families._small_fit import Called, Ended, SmallFit, as_it_is
from reliability.family import Failure, Family, Mended, Report

from p2gs_jax.errors import UserError
from p2gs_jax.train.state import FitState
from p2gs_jax.types import Params

NAME = "faithfulness"
ABOUT = """
What rounding does to a small fit in which exposures and gammas are learned and Gaussians are born.
Float64: along 1,000 steps, every 50th is taken again from the same state in double precision, all
of it but what is counted and sorted and the noise on the means. Survived: the loss is within 1e-5,
and the gradient of every group of parameters within 1e-2 of its norm, in the median of all steps
within 1e-4 (of a tenth of its usual norm, where the step's is less). Float32 has seven digits, and
sums of some hundred terms cost two; where a pixel equals its photograph to the last bit, rounding
chooses the sign of L1, which alone is up to 1e-3 of a gradient. Subnormals: starts with numbers
below float32's normal range, which XLA takes for zero; survived: all stays finite, and the loss is
within 1e-4 of that in float64, where they are normal. Last bit, order, vectors: the same fit from a
start that differs in one last bit (1,000 steps), with its Gaussians stored or the views of a step
summed in another order, or compiled for narrower vectors (300 steps). Survived: held-out PSNR and
exposures move no more than another seed moves them, three deviations of the difference of two
seeds.
"""
MENDED = (
    Mended(
        "no step could be taken in float64: the rasterizer's sums were float32 whatever it was "
        "given, and so were photographs, Adam's bias correction and image sizes",
        "tests/train/test_step_blocks.py::test_a_step_agrees_with_one_in_float64",
    ),
    Mended(
        "the gradient of exposures was no number where one of them was below float32's normal "
        "range",
        "tests/photometry/test_gauge.py::test_exposures_below_the_normal_numbers_have_a_gauge",
    ),
    Mended(
        "1 - SSIM of what is fitted well was up to 9 % off in float32, its gradient .1 %: means of "
        "squares cancelled",
        "tests/losses/test_image.py::test_what_is_fitted_well_keeps_its_digits",
    ),
)
GRADIENT, USUAL, LOSS, SUBNORMAL_LOSS = 1e-2, 1e-4, 1e-5, 1e-4
# Of a group's usual gradient, what the least is judged by: spheres have none by their rotation.
LEAST = 0.1
# Deviations of the difference of two seeds.
SPREADS = 3.0
LOOKED_AT = (1, 10, 100, 300)


@dataclasses.dataclass(frozen=True)
class Size:
    """How much is tried.

    Attributes:
        steps: of a fit whose steps are compared, or that is followed from another last bit.
        every: steps between two that are taken in float64 too.
        short: steps of all other fits.
        seeds: fits of every instruction set.
        subnormal_steps: of a fit from subnormal numbers.
    """

    steps: int = 1000
    every: int = 50
    short: int = 300
    seeds: int = 10
    subnormal_steps: int = 25


QUICK = Size(steps=100, every=20, subnormal_steps=3)


class Part(NamedTuple):
    """What an experiment found.

    Attributes:
        tried: how many trials.
        failures: those that were not survived.
        rows: figures.
    """

    tried: int
    failures: list[Failure]
    rows: list[dict[str, Any]]


class Spread(NamedTuple):
    """What another seed does.

    Attributes:
        psnr: deviation of the held-out PSNR, dB.
        ev: deviation of an exposure, stops; root mean square over views.
    """

    psnr: float
    ev: float


def run(quick: bool, out: Path, report: Report) -> Family:
    """Try all; `quick`: float64 and subnormals, of a shorter fit."""
    size = QUICK if quick else Size()
    parts = []

    def add(name: str, part: Part) -> None:
        parts.append(part)
        for figure in part.rows:
            report(f"{NAME}: {figure}")
        report(f"{NAME}: {name}: {len(part.failures)} of {part.tried} failed")

    fit = SmallFit(_new(out / "fit"))
    add("float64", against_float64(fit, size))
    add("subnormals", subnormals(fit, size))
    if not quick:
        part, spread = over_seeds(out, size, report)
        add("vectors", part)
        add("last bit", last_bit(fit, size, spread))
        add("order", orders(fit, size, spread))
    failures = tuple(f for part in parts for f in part.failures)
    tried = sum(part.tried for part in parts)
    figures = tuple(row for part in parts for row in part.rows)
    return Family(NAME, tried, tried - len(failures), failures, MENDED, figures=figures)


def _new(folder: Path) -> Path:
    folder.mkdir(parents=True)
    return folder


def row(
    experiment: str, quantity: str, values: Iterable[float], limit: float | None = None
) -> dict[str, Any]:
    """Return a row of the table."""
    values = [float(v) for v in values]
    return {
        "experiment": experiment,
        "quantity": quantity,
        "of": len(values),
        "median": statistics.median(values),
        "largest": max(values),
        "limit": "" if limit is None else limit,
    }


def _beyond(name: str, value: float, limit: float) -> list[Failure]:
    """Return a failure where a value is beyond its limit, or no number."""
    return [] if value <= limit else [Failure(name, f"{value:.3g}, more than {limit:.3g}")]


def against_float64(fit: SmallFit, size: Size) -> Part:
    """Take steps of a fit in float64 as well."""
    gaps = _gaps(fit, size.steps, size.every)
    first, later = gaps[0], gaps[1:]
    failures: list[Failure] = []
    least = {k: LEAST * statistics.median(g.gradient[k].size for g in gaps) for k in GROUPS}
    for gap in gaps:
        at = f"float64, step {gap.step}"
        failures += _beyond(f"{at}: loss", gap.loss, LOSS)
        for k in GROUPS:
            failures += _beyond(f"{at}: gradient of {k}", gap.gradient[k].over(least[k]), GRADIENT)
    for k in GROUPS:
        usual = statistics.median(gap.gradient[k].over(least[k]) for gap in gaps)
        failures += _beyond(f"float64: gradient of {k}, median", usual, USUAL)
    name = "float64"
    rows = [row(name, "loss", [g.loss for g in gaps], LOSS)]
    rows += [
        row(name, f"gradient of {k}", [g.gradient[k].over(least[k]) for g in gaps], GRADIENT)
        for k in GROUPS
    ]
    for what in ("update", "parameters"):
        rows += [
            row(name, f"{what} of {k}", [getattr(g, what)[k].over() for g in later]) for k in GROUPS
        ]
    rows += [row(f"{name}, first step", f"update of {k}", [first.update[k].over()]) for k in GROUPS]
    return Part(len(gaps) * (1 + len(GROUPS)) + len(GROUPS), failures, rows)


def _gaps(
    fit: SmallFit, steps: int, every: int, begin: Callable[[FitState], FitState] | None = None
) -> list[Gaps]:
    """Fit, and take some of the steps in float64 too.

    Args:
        fit: the scene.
        steps: of the fit.
        every: steps between two that are compared.
        begin: changes the state, on the host, before the first step.
    """
    gaps: list[Gaps] = []

    def watch(called: Called, state: FitState, inputs: tuple):
        if begin is not None and int(state.step) == 0:
            state = jax.tree.map(jnp.asarray, begin(jax.tree.map(np.array, state)))
        if int(state.step) % every:
            return as_it_is(called, state, inputs)
        taken, gap = compare(called, state, inputs)
        if gap is not None:
            gaps.append(gap)
        return taken

    fit.taken({"train.steps": steps}, watch=watch)
    return gaps


def over_seeds(out: Path, size: Size, report: Report) -> tuple[Part, Spread]:
    """Fit under several seeds, each compiled for two instruction sets."""
    wide, narrow = instruction_sets()
    a = scores_under("", out / "wide", size.short, size.seeds)
    report(f"{NAME}: {wide}: {a}")
    b = scores_under(narrow, out / "narrow", size.short, size.seeds)
    report(f"{NAME}: {narrow}: {b}")
    spread = spread_of(a)
    name = f"vectors: {wide} against {narrow}"
    psnr, ev = _apart(a, b)
    limits = (_limit(spread.psnr), _limit(spread.ev))
    failures: list[Failure] = []
    for seed, (p, e) in enumerate(zip(psnr, ev, strict=True)):
        failures += _beyond(f"{name}, seed {seed}: PSNR, dB", p, limits[0])
        failures += _beyond(f"{name}, seed {seed}: exposures, EV", e, limits[1])
    signed = np.subtract(a.psnr, b.psnr)
    rows = [
        row("seeds", "deviation of PSNR, dB", [spread.psnr]),
        row("seeds", "deviation of exposures, EV", [spread.ev]),
        row("seeds", "PSNR, dB", a.psnr),
        row("seeds", "error of exposures, EV", a.ev_error),
        row(name, "PSNR, dB", psnr, limits[0]),
        row(name, "PSNR, dB: mean over seeds, with its sign", [signed.mean()]),
        row(name, "exposures, EV", ev, limits[1]),
    ]
    return Part(2 * len(psnr), failures, rows), spread


def instruction_sets() -> tuple[str, str]:
    """Return the widest that the machine has, of those compared, and the next."""
    flags = Path("/proc/cpuinfo").read_text() if Path("/proc/cpuinfo").exists() else ""
    return ("AVX512", "AVX2") if "avx512f" in flags else ("AVX2", "SSE4_2")


def spread_of(scores: Scores) -> Spread:
    """Return how far fits of several seeds are from each other."""
    deviations = np.std(scores.ev, axis=0, ddof=1)
    return Spread(float(np.std(scores.psnr, ddof=1)), float(np.sqrt(np.mean(deviations**2))))


def _apart(a: Scores, b: Scores) -> tuple[np.ndarray, np.ndarray]:
    """Return for each seed the gap in PSNR and the root mean square of those in exposures."""
    psnr = np.abs(np.subtract(a.psnr, b.psnr))
    return psnr, np.sqrt(np.mean(np.subtract(a.ev, b.ev) ** 2, axis=1))


def _limit(deviation: float) -> float:
    return SPREADS * float(np.sqrt(2)) * deviation


def last_bit(fit: SmallFit, size: Size, spread: Spread) -> Part:
    """Fit from starts that differ in the last bit of one number."""
    options = {"train.steps": size.steps}
    base, path = _followed(fit, options, None)
    again, _ = _followed(fit, options, None)
    name = "last bit: nothing changed"
    same = all(
        np.array_equal(x, y)
        for x, y in zip(jax.tree.leaves(base.state), jax.tree.leaves(again.state), strict=True)
    )
    failures = [] if same else [Failure(name, "the same fit again gives other numbers")]
    rows: list[dict[str, Any]] = []
    others, paths = [], []
    for params in nudged(fit.prepared.params):
        other, followed = _followed(fit, options, params)
        others.append(other)
        paths.append(followed)
    extent = fit.prepared.extent
    for at in (k for k in LOOKED_AT if k in path):
        away = np.concatenate([np.linalg.norm(p[at] - path[at], axis=1) for p in paths]) / extent
        rows.append(row("last bit", f"means after {at} steps, over the extent", away))
    part = _moved("last bit", base, others, spread)
    return Part(1 + part.tried, failures + part.failures, rows + part.rows)


def nudged(params: Params) -> list[Params]:
    """Return starts of which each differs in the last bit of one number."""
    g, p = params.gaussians, params.photometry

    def next_to(a):
        a = np.array(a)
        a.flat[0] = np.nextafter(a.flat[0], np.float32(np.inf))
        return jnp.asarray(a)

    return [
        dataclasses.replace(params, gaussians=dataclasses.replace(g, means=next_to(g.means))),
        dataclasses.replace(
            params, gaussians=dataclasses.replace(g, opacity_logits=next_to(g.opacity_logits))
        ),
        dataclasses.replace(
            params, photometry=dataclasses.replace(p, raw_exposures=next_to(p.raw_exposures))
        ),
    ]


def _followed(fit: SmallFit, options: Mapping, params: Params | None):
    """Return the end of a fit, and the means of those that began with it after some steps."""
    path: dict[int, np.ndarray] = {}
    count = fit.prepared.params.gaussians.capacity

    def watch(called: Called, state: FitState, inputs: tuple):
        step = int(state.step)
        if step in LOOKED_AT:
            path[step] = np.array(state.params.gaussians.means)[:count].astype(np.float64)
        return as_it_is(called, state, inputs)

    return fit.judged(fit.taken(options, params, watch=watch)), path


def _moved(name: str, base: Ended, others: Sequence[Ended], spread: Spread) -> Part:
    """Compare the ends of fits with that of another."""
    psnr = [abs(other.psnr - base.psnr) for other in others]
    ev = [float(np.sqrt(np.mean((other.ev - base.ev) ** 2))) for other in others]
    limits = (_limit(spread.psnr), _limit(spread.ev))
    failures: list[Failure] = []
    for k, (p, e) in enumerate(zip(psnr, ev, strict=True)):
        failures += _beyond(f"{name} {k}: PSNR, dB", p, limits[0])
        failures += _beyond(f"{name} {k}: exposures, EV", e, limits[1])
    rows = [row(name, "PSNR, dB", psnr, limits[0]), row(name, "exposures, EV", ev, limits[1])]
    return Part(2 * len(others), failures, rows)


def orders(fit: SmallFit, size: Size, spread: Spread) -> Part:
    """Store Gaussians, and sum the views of a step, in other orders."""
    # Births and noise are drawn by place in storage: without them only the order differs.
    still = {"train.steps": size.short, "densify.method": None}
    base = fit.judged(fit.taken(still))
    count = fit.prepared.params.gaussians.capacity
    others = []
    for seed in range(3):
        order = np.random.default_rng(seed).permutation(count)
        params = dataclasses.replace(
            fit.prepared.params,
            gaussians=jax.tree.map(
                lambda a, order=order: jnp.asarray(np.asarray(a)[order]),
                fit.prepared.params.gaussians,
            ),
        )
        others.append(fit.judged(fit.taken(still, params)))
    stored = _moved("order of Gaussians in storage", base, others, spread)

    batched = {"train.steps": size.short, "train.batch": 4}
    base = fit.judged(fit.taken(batched))
    others = [
        fit.judged(fit.taken(batched, watch=_in_order(order)))
        for order in ((3, 2, 1, 0), (1, 2, 3, 0))
    ]
    views = _moved("order of views in a step of 4", base, others, spread)
    parts = (stored, views)
    return Part(
        sum(p.tried for p in parts),
        [f for p in parts for f in p.failures],
        [r for p in parts for r in p.rows],
    )


def _in_order(order: Sequence[int]) -> Callable:
    def watch(called: Called, state: FitState, inputs: tuple):
        batch, partner, controls = inputs
        batch, partner = jax.tree.map(lambda a: np.asarray(a)[list(order)], (batch, partner))
        return called.run(state, batch, partner, controls)

    return watch


def subnormals(fit: SmallFit, size: Size) -> Part:
    """Start from numbers below the normal ones of float32."""
    failures: list[Failure] = []
    rows = [row("subnormals", "XLA takes them for zero (1: yes)", [float(flushed())])]
    tried = 0
    for case, begin in SUBNORMAL.items():
        every = max(1, size.subnormal_steps // 5)
        name = f"subnormals: {case}"
        try:
            gaps = _gaps(fit, size.subnormal_steps, every, begin)
        except UserError as error:
            tried += 1
            failures.append(Failure(name, str(error)))
            continue
        for gap in gaps:
            tried += 1
            failures += _beyond(f"{name}, step {gap.step}: loss", gap.loss, SUBNORMAL_LOSS)
            if not gap.finite:
                failures.append(Failure(f"{name}, step {gap.step}", "a parameter is not finite"))
        rows.append(row(name, "loss", [g.loss for g in gaps], SUBNORMAL_LOSS))
    return Part(tried, failures, rows)


def flushed() -> bool:
    """Return whether compiled programs take subnormal numbers for zero."""
    return float(jax.jit(lambda x: x * np.float32(2))(np.float32(TINY))) == 0.0


TINY = 1e-40
# The logarithm of 8e-40.
LOG_TINY = -90.0


def _every_other(name: str, value: float) -> Callable[[FitState], FitState]:
    """Return what gives every other Gaussian this value."""

    def begin(state: FitState) -> FitState:
        gaussians = state.params.gaussians
        array = np.array(getattr(gaussians, name))
        array[::2] = value
        changed = dataclasses.replace(gaussians, **{name: array})
        return dataclasses.replace(
            state, params=dataclasses.replace(state.params, gaussians=changed)
        )

    return begin


def _dark_view(state: FitState) -> FitState:
    photometry = state.params.photometry
    exposures = np.array(photometry.raw_exposures)
    exposures[0] = LOG_TINY
    photometry = dataclasses.replace(photometry, raw_exposures=exposures)
    return dataclasses.replace(
        state, params=dataclasses.replace(state.params, photometry=photometry)
    )


def _small_moments(state: FitState) -> FitState:
    def small(a):
        return np.full_like(a, TINY) if a.dtype == np.float32 else a

    return dataclasses.replace(state, opt_state=jax.tree.map(small, state.opt_state))


SUBNORMAL: dict[str, Callable[[FitState], FitState]] = {
    "opacities of 8e-40": _every_other("opacity_logits", LOG_TINY),
    "scales of 8e-40": _every_other("log_scales", LOG_TINY),
    "coordinates of 1e-40": _every_other("means", TINY),
    "quaternions of 1e-40": _every_other("quats", TINY),
    "an exposure of 8e-40": _dark_view,
    "moments of 1e-40": _small_moments,
}
