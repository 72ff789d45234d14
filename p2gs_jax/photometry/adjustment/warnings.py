"""What the user should know of a solution, in sentences."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from p2gs_jax.photometry.adjustment.solve import Fit
from p2gs_jax.photometry.solution import MIN_OBSERVATIONS

# A channel off by this much in a view is worth a word.
NOTICEABLE_BALANCE_EV = 0.1
# Of a typical standard error, what is left of the way that is worth no word.
NEGLIGIBLE = 0.1


def solver_warnings(
    fit: Fit,
    errors: Float[np.ndarray, " k"],
    lost: Int[np.ndarray, " n"],
    names: Sequence[str],
) -> list[str]:
    """Say where the numbers themselves are not to be trusted.

    Args:
        fit: the solution.
        errors: standard errors of log exposures, where there are any.
        lost: views that have none though they were observed.
        names: of all views.
    """
    out = []
    typical = float(np.median(errors)) if errors.size else 0.0
    if not fit.converged and fit.left > NEGLIGIBLE * typical:
        out.append(
            f"The photometric solution had not settled after {fit.rounds} rounds (its last moved a "
            f"parameter by {fit.moved:.1e}, log units): exposures may be off by more than their "
            "standard errors say. Compare them with --photometry.no-select and a simpler "
            "--photometry.model."
        )
    if len(lost):
        out.append(
            f"The standard errors of {len(lost)} training view(s) cannot be told: what joins them "
            f"to the others is lost in rounding ({_listed(lost, names)})."
        )
    return out


def observation_warnings(
    per_view: Int[np.ndarray, " v"],
    component: Int[np.ndarray, " v"],
    active: Bool[np.ndarray, " v"],
    balance: Float[np.ndarray, "v 3"],
    names: Sequence[str],
) -> list[str]:
    """Say what the observations do not tell, or tell of more than exposure.

    Args:
        per_view: usable observations of each view.
        component: views with equal numbers share points.
        active: views that have any, or a known exposure.
        balance: residual of red, green, blue less their mean, stops.
        names: of all views.
    """
    out = []
    few = np.flatnonzero(per_view < MIN_OBSERVATIONS)
    if len(few):
        out.append(
            f"{len(few)} training view(s) have fewer than {MIN_OBSERVATIONS} usable track "
            f"observations; their exposures are uncertain ({_listed(few, names)})."
        )
    groups = len(set(component[active].tolist()))
    if groups > 1:
        out.append(
            f"The tracks fall into {groups} groups of views that share no point: exposures can "
            "be compared only inside a group."
        )
    off = np.nan_to_num(np.abs(balance).max(1))
    tinted = np.flatnonzero(off > NOTICEABLE_BALANCE_EV)
    if len(tinted):
        worst = int(off.argmax())
        channels = ", ".join(
            f"{name} {value:+.2f}"
            for name, value in zip(("red", "green", "blue"), balance[worst], strict=True)
        )
        out.append(
            f"White balance changes: {len(tinted)} training view(s) are tinted against the others "
            f"({_listed(tinted, names)}; most of all {_listed([worst], names)}, by {channels} EV). "
            "An exposure here is one number for all channels."
        )
    return out


def _listed(rows: Sequence[int] | Int[np.ndarray, " n"], names: Sequence[str]) -> str:
    head = ", ".join(names[r] if names else f"row {r}" for r in rows[:8])
    return head + (", ..." if len(rows) > 8 else "")
