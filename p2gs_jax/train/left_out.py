"""What no static scene explains is left out of the steps that follow, without boxes.

At set shares of the run every training view is held against its render. What exceeds by far the
view's own noise, and twice what the same surface shows at other times, gets no weight from there
on (`evaluate/unexplained.py`). A surface that no other view shows is never left out, and a view of
which too much would be is left whole: there the fit is at fault. Each look starts afresh, so what
was left out wrongly comes back as soon as other views have taught the fit what it looks like.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np

from p2gs_jax.config import FitConfig
from p2gs_jax.core.clock import Stopwatch
from p2gs_jax.evaluation.passes import ArrayStore, map_in_order, most_bytes
from p2gs_jax.evaluation.unexplained import Residuals, Unexplained
from p2gs_jax.photometry.display import develop, display_of_view
from p2gs_jax.render.capacity import make_renderer
from p2gs_jax.render.objects import with_corrections
from p2gs_jax.render.warp import surface_depth
from p2gs_jax.run.left_out_file import LeftOutFile
from p2gs_jax.train.host import HostState
from p2gs_jax.train.state import FitState
from p2gs_jax.train.views import TrainingViews

# Of a view of which more than this would be left out, nothing is (ours).
MOST_OF_A_VIEW = 0.35


class Looked(NamedTuple):
    """What a look found.

    Attributes:
        found: by training view, in the order of `Photometry`; nothing of views that stay whole.
        whole: views of which too much would have been left out.
    """

    found: dict[int, Unexplained]
    whole: int


class LeftOut:
    """Looks for what no static scene explains, and takes it out of the steps to come.

    Args:
        cfg: whether, and when; renderer and formation model.
        views: the training views; they forget the pixels.
        file: keeps every look, for runs that are resumed.
        clock: receives the seconds of `looking`.
        on_message: told what was left out.
    """

    def __init__(
        self,
        cfg: FitConfig,
        views: TrainingViews,
        file: LeftOutFile,
        clock: Stopwatch,
        on_message: Callable[[str], None],
    ):
        self._cfg, self._views, self._file = cfg, views, file
        self._clock, self._on_message = clock, on_message
        self._now: Looked | None = None

    def begin(self, host: HostState) -> None:
        """Begin a session: the first, or one that continues after the looks that `host` knows.

        Raises:
            UserError: what these left out cannot be read.
        """
        if self._cfg.dynamics.unexplained == "fit":
            return
        self._file.keep_until(host.looked_step)
        if host.looked_step:
            found, whole = self._file.read(host.looked_step)
            self._leave(Looked(found, whole), host.looked_step)

    def due(self, host: HostState) -> bool:
        """Return whether it is time for a look."""
        dynamics = self._cfg.dynamics
        if dynamics.unexplained == "fit":
            return False
        # Up to half a step: progress is a sum.
        now = host.progress + 0.5 * host.pace
        return any(host.looked_at < at <= now < 1 for at in dynamics.unexplained_at)

    def look(self, state: FitState, host: HostState) -> None:
        """Hold every training view against its render; leave out what nothing static explains.

        Args:
            state: after a burst.
            host: counters; changed.
        """
        with self._clock("looking"):
            looked = look(state, self._views, self._cfg, max(host.shrink, 1))
            host.looked_at, host.looked_step = host.progress + 0.5 * host.pace, host.step
            self._file.write(host.step, looked.found, looked.whole)
        self._leave(looked, host.step)

    def summary(self) -> dict[int, Unexplained] | None:
        """Return what is left out by row of the scene, or None where it was never looked for."""
        if self._now is None:
            return None
        return {self._views.rows[row]: found for row, found in self._now.found.items()}

    def _leave(self, looked: Looked, step: int) -> None:
        self._now = looked
        self._views.hide({row: found.mask for row, found in looked.found.items()})
        self._on_message(described(looked, step))


def described(looked: Looked, step: int) -> str:
    """Return what was left out, in words."""
    shares = [found.share for found in looked.found.values()]
    most, mean = max(shares, default=0.0), float(np.mean(shares)) if shares else 0.0
    said = (
        f"After step {step}: {mean:.1%} of the pixels of the training views are explained by no "
        f"static scene and left out from here on (most of one view: {most:.0%})"
    )
    if looked.whole:
        said += (
            f"; {looked.whole} views stay whole, because more than {MOST_OF_A_VIEW:.0%} of each "
            "would be"
        )
    return said + "."


def look(state: FitState, views: TrainingViews, cfg: FitConfig, shrink: int) -> Looked:
    """Return what no static scene explains in the training views.

    Args:
        state: the fit so far.
        views: the training views.
        cfg: renderer and formation model.
        shrink: factor by which images are shrunk.
    """
    params, population = state.params, state.population
    small = jax.tree.map(np.asarray, dataclasses.replace(params, gaussians=None))
    render = make_renderer(cfg.render)
    store = views.store

    def shown(row: int) -> tuple[Any, ...]:
        photograph, mask = store.get(views.rows[row], shrink)
        (camera,) = with_corrections((views.camera(row, shrink),), params.poses)
        result = render(params.gaussians, population.alive, camera, population.owner)
        own = display_of_view(small, row, cfg.photometry)
        own = dataclasses.replace(own, backdrop=store.backdrop_values)
        ldr = develop(result.linear, own, alpha=result.alpha)
        depth = np.asarray(surface_depth(result))
        return row, np.asarray(ldr), photograph, mask, depth, np.asarray(camera.K)

    with ArrayStore(most_bytes(cfg.data.cache_mb)) as arrays:
        residuals = Residuals([store.views[row] for row in views.rows], arrays)
        for given in map_in_order(shown, range(len(views))):
            residuals.add(*given)
        return bounded(residuals.find(known_only=True))


def bounded(found: Mapping[int, Unexplained]) -> Looked:
    """Return what is left out; views of which that would be too much stay whole."""
    too_much = {row for row, one in found.items() if one.share > MOST_OF_A_VIEW}
    kept = {
        row: Unexplained(np.zeros_like(one.mask), 0.0) if row in too_much else one
        for row, one in found.items()
    }
    return Looked(kept, len(too_much))
