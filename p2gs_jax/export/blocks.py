"""A population cut in space into parts of equal number, each in a file of its own."""

from __future__ import annotations

from pathlib import Path

import jax
import numpy as np
from jaxtyping import Float, Int

from p2gs_jax.core.atomic import atomic_folder
from p2gs_jax.core.numerics import on_device
from p2gs_jax.formats.spz import read_spz, write_spz
from p2gs_jax.types import Gaussians


def write_blocks(folder: Path, gaussians: Gaussians, count: int) -> tuple[Gaussians, list[dict]]:
    """Write a folder of SPZ files, 000.spz and so on, whole or not at all.

    Args:
        folder: made, or replaced.
        gaussians: with display colours.
        count: how many files.

    Returns:
        All Gaussians as the files hold them, and of every file its name, number of Gaussians, and
        the corners of the box of their centres.

    Raises:
        UserError: gsply is not installed, or a position does not fit the format.
    """
    host = jax.tree.map(np.asarray, gaussians)
    table: list[dict] = []
    with atomic_folder(folder) as temporary:
        for k, part in enumerate(cut(host.means, count)):
            name, means = f"{k:03d}.spz", host.means[part]
            write_spz(temporary / name, jax.tree.map(lambda a, part=part: a[part], host))
            box = {"low": means.min(0).tolist(), "high": means.max(0).tolist()}
            table.append({"file": name, "gaussians": len(part), **box})
    found = [read_spz(folder / one["file"]) for one in table]
    return jax.tree.map(lambda *parts: on_device(np.concatenate(parts)), *found), table


def cut(means: Float[np.ndarray, "n 3"], count: int) -> list[Int[np.ndarray, " k"]]:
    """Return rows of every part, each in order; numbers differ by one at most.

    Where there are more parts than Gaussians, some are left out.

    Args:
        means: centres.
        count: how many parts; cut one after another, across their longest side.
    """
    return _parts(means, np.arange(len(means)), max(1, min(count, len(means))))


def _parts(means: np.ndarray, rows: np.ndarray, count: int) -> list[np.ndarray]:
    if count == 1:
        return [np.sort(rows)]
    here = means[rows]
    axis = int(np.argmax(here.max(0) - here.min(0)))
    fewer = count // 2
    # As evenly as whole numbers can be, over all parts.
    at = len(rows) * fewer // count
    order = np.argsort(here[:, axis], kind="stable")
    low, high = rows[order[:at]], rows[order[at:]]
    return _parts(means, low, fewer) + _parts(means, high, count - fewer)
