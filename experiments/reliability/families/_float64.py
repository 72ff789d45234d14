"""A step as a fit takes it, and the same step from the same state in float64."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from reliability.families._small_fit import Called

from p2gs_jax.train.optimizer import B1
from p2gs_jax.train.state import FAULT_NONE, FitState

OF_GAUSSIANS = ("means", "quats", "log_scales", "opacity_logits", "sh")
OF_VIEWS = ("raw_exposures", "raw_gammas")
GROUPS = (*OF_GAUSSIANS, *OF_VIEWS)


class Gap(NamedTuple):
    """How far values are from exact ones.

    Attributes:
        apart: norm of the difference.
        size: norm of the exact ones.
    """

    apart: float
    size: float

    def over(self, least: float = 0.0) -> float:
        """Return the difference relative to the size, or to `least` where that is larger."""
        return self.apart / max(self.size, least, np.finfo(float).tiny)


class Gaps(NamedTuple):
    """How far a step in float32 is from one in float64.

    Attributes:
        step: steps before it.
        loss: relative.
        gradient: of every group of parameters.
        update: what was added to them.
        parameters: after the step.
        finite: all that the float32 step wrote is.
    """

    step: int
    loss: float
    gradient: dict[str, Gap]
    update: dict[str, Gap]
    parameters: dict[str, Gap]
    finite: bool


def compare(called: Called, state: FitState, inputs: tuple) -> tuple[Any, Gaps | None]:
    """Take a step, and again in float64; return what the first returned, and the gaps.

    There are none where the step found no room: it is taken again later.

    What is sorted and counted stays what it is: depths order tile lists by their bits in float32,
    and the noise on the means is the same float32 numbers in both.

    Args:
        called: the step.
        state: before it; donated.
        inputs: its other arguments.
    """
    before = jax.tree.map(np.array, state)
    forgetful = _without_moments(before)
    flat, _ = called.run(_on_device(forgetful), *inputs)
    gradient = _gradient(flat, called)
    taken = called.run(state, *inputs)
    after, report = jax.device_get(taken)
    if int(after.fault.kind) != FAULT_NONE:
        return taken, None
    with jax.enable_x64(True):
        wide = [
            jax.device_get(
                called.step(
                    _on_device(_widened(start)),
                    *_widened(inputs),
                    room=called.key.room,
                    degree=called.key.degree,
                )
            )
            for start in (forgetful, before)
        ]
    exact_gradient = _gradient(wide[0][0], called)
    exact, exact_report = wide[1]
    old, new, expected = (_groups(s.params) for s in (before, after, exact))
    gaps = Gaps(
        int(before.step),
        abs(float(report.loss) / float(exact_report.loss) - 1),
        {k: _gap(gradient[k], exact_gradient[k]) for k in GROUPS},
        {k: _gap(new[k] - old[k], expected[k] - old[k]) for k in GROUPS},
        {k: _gap(new[k], expected[k]) for k in GROUPS},
        all(np.isfinite(a).all() for a in new.values()),
    )
    return taken, gaps


def _gap(value: np.ndarray, exact: np.ndarray) -> Gap:
    return Gap(float(np.linalg.norm(value - exact)), float(np.linalg.norm(exact)))


def _groups(params) -> dict[str, np.ndarray]:
    """Return parameters, or what has their structure, by group."""
    pairs = [(params.gaussians, name) for name in OF_GAUSSIANS]
    pairs += [(params.photometry, name) for name in OF_VIEWS]
    return {name: np.asarray(getattr(of, name), np.float64) for of, name in pairs}


def _gradient(state: FitState, called: Called) -> dict[str, np.ndarray]:
    """Return the gradient of a step that began without moments, from its first moments."""
    adam, rest = jax.device_get((state.opt_state.gaussians[0].mu, state.opt_state.rest[0].mu[0]))
    b1 = called.step.cfg.optimizer.b1
    found = {k: np.asarray(getattr(adam, k), np.float64) / (1 - b1) for k in OF_GAUSSIANS}
    return found | {k: np.asarray(getattr(rest, k), np.float64) / (1 - B1) for k in OF_VIEWS}


def _without_moments(state: FitState) -> FitState:
    return dataclasses.replace(state, opt_state=jax.tree.map(np.zeros_like, state.opt_state))


def _widened(tree: Any) -> Any:
    def wide(a):
        a = np.asarray(a)
        return a.astype(np.float64) if a.dtype == np.float32 else a

    return jax.tree.map(wide, tree)


def _on_device(tree: Any) -> Any:
    return jax.tree.map(jnp.asarray, tree)
