"""Millions of Gaussians on the CPU: blocks of neighbours, of which a view takes those it may show.

A renderer projects all that it is given. Of a whole district a view shows little, so what cannot
reach it is left out before: whole blocks by their bounding ball, then single Gaussians. What is
left keeps its order, so the picture is the same bit for bit.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from p2gs_jax.config import RenderConfig
from p2gs_jax.render.cutoff import smallest_cutoff
from p2gs_jax.render.project import LOG_SCALE_RANGE, TANGENT_LIMIT
from p2gs_jax.render.visible import SLACK, in_view
from p2gs_jax.types import Camera, Gaussians

# From this many on it is worth while.
FEWEST = 2_000_000
BLOCK = 8192
# A view that more of the blocks may reach is rendered whole: looking at each Gaussian costs, too.
MOST_BLOCKS = 0.5
# Cells of the grid along an axis, as a power of 2, by which neighbours are found.
_CELL_BITS = 10


class Blocks:
    """A population that does not move, cut into blocks of neighbours."""

    def __init__(self, gaussians: Gaussians, alive: Bool[np.ndarray, " n"], cfg: RenderConfig):
        """Sort the population.

        Args:
            gaussians: on the host or a CPU device; none of them moves.
            alive: slots in use; others are never taken.
            cfg: cutoffs.
        """
        self._gaussians = jax.tree.map(np.asarray, gaussians)
        self._alive, self._cfg = np.asarray(alive), cfg
        g, used = self._gaussians, np.flatnonzero(alive)
        finite = np.isfinite(g.means[used]).all(1)
        # Where a Gaussian is not anywhere, no view shows it.
        used = used[finite]
        self._order = used[np.argsort(_morton(g.means[used]), kind="stable")].astype(np.int32)
        starts = np.arange(0, len(self._order), BLOCK)
        if not len(starts):
            return
        means = g.means[self._order].astype(np.float64)
        low, high = (np.minimum.reduceat(means, starts), np.maximum.reduceat(means, starts))
        self._centers = (low + high) / 2
        self._radii = np.linalg.norm(high - low, axis=1) / 2
        widest = np.exp(np.clip(g.log_scales[self._order].max(1), *LOG_SCALE_RANGE))
        self._widest = np.maximum.reduceat(widest.astype(np.float64), starts)
        logits = g.opacity_logits[self._order].astype(np.float64)
        reach = -np.logaddexp(0.0, -logits) - np.log(smallest_cutoff(cfg))
        self._reach = np.maximum(np.maximum.reduceat(reach, starts), 0.0)

    def leave_out_much(self, camera: Camera) -> bool:
        """Return whether a view is worth culling for."""
        if not len(self._order):
            return False
        return bool(self.blocks_in_view(camera).mean() <= MOST_BLOCKS)

    def of_view(self, camera: Camera) -> Int[np.ndarray, " v"]:
        """Return the rows of the Gaussians that may reach a view, in order."""
        if not len(self._order):
            return self._order
        near = np.flatnonzero(self.blocks_in_view(camera))
        if not len(near):
            return self._order[:0]
        parts = [self._order[k * BLOCK : (k + 1) * BLOCK] for k in near]
        kept = [rows[self._seen(rows, camera)] for rows in parts]
        return np.sort(np.concatenate(kept))

    def blocks_in_view(self, camera: Camera) -> Bool[np.ndarray, " b"]:
        """Return which blocks may hold what reaches a view: a conservative bound.

        That of `visible.in_view`, times z, is linear in the position; of a ball it is largest on
        its surface.
        """
        viewmat, K = np.asarray(camera.viewmat, np.float64), np.asarray(camera.K, np.float64)
        local = self._centers @ viewmat[:3, :3].T + viewmat[:3, 3]
        r, z = self._radii, local[:, 2]
        seen = z + r > self._cfg.near
        deviations = np.sqrt(2 * self._reach)
        pixels = deviations * np.sqrt(self._cfg.blur) + SLACK
        for axis, size in ((0, camera.width), (1, camera.height)):
            f, c = K[axis, axis], K[axis, 2]
            limit = TANGENT_LIMIT * size / (2 * f)
            spread = deviations * self._widest * f * np.sqrt(1 + limit**2)
            for sign, margin in ((1.0, c + pixels), (-1.0, size - c + pixels)):
                farthest = sign * f * local[:, axis] + margin * z + r * np.hypot(f, margin)
                seen &= farthest + spread >= 0
        return seen

    def take(self, rows: Int[np.ndarray, " v"]) -> tuple[Gaussians, Bool[np.ndarray, " room"]]:
        """Return some Gaussians, padded to one of few lengths, and which of them count.

        Every length needs programs of its own.
        """
        room = _room(len(rows))
        alive = np.arange(room) < len(rows)
        some = np.zeros(room, np.int64)
        some[: len(rows)] = rows
        return jax.tree.map(lambda a: a[some], self._gaussians), alive

    def _seen(self, rows: Int[np.ndarray, " k"], camera: Camera) -> Bool[np.ndarray, " k"]:
        g = self._gaussians
        some = Gaussians(
            g.means[rows], g.quats[:0], g.log_scales[rows], g.opacity_logits[rows], g.sh[:0]
        )
        host: Any = replace(
            camera, viewmat=np.asarray(camera.viewmat), K=np.asarray(camera.K), objects=None
        )
        alive: Any = self._alive[rows]
        return np.asarray(in_view(some, alive, host, self._cfg))


def _room(count: int) -> int:
    """Return `count` rounded up to a power of 2, or one and a half."""
    power = BLOCK
    while power < count:
        power *= 2
    return power * 3 // 4 if power > BLOCK and count <= power * 3 // 4 else power


def _morton(means: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, " n"]:
    """Return a number by which neighbours in space are mostly neighbours in order.

    The grid is that of the bulk: what lies far outside shares its outermost cells.
    """
    if not len(means):
        return np.zeros(0, np.int64)
    some = means[:: max(1, len(means) // 100_000)]
    low, high = np.quantile(some, 0.01, axis=0), np.quantile(some, 0.99, axis=0)
    cells = 2**_CELL_BITS
    scaled = (means - low) / np.maximum(high - low, 1e-12) * cells
    at = np.clip(scaled, 0, cells - 1).astype(np.int64)
    out = np.zeros(len(means), np.int64)
    for bit in range(_CELL_BITS):
        for axis in range(3):
            out |= ((at[:, axis] >> bit) & 1) << (3 * bit + axis)
    return out
