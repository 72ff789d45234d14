"""`p2gs-jax render`."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from p2gs_jax.commands.console import stdout
from p2gs_jax.errors import UserError
from p2gs_jax.evaluate.evaluate import ViewResult
from p2gs_jax.finish import write_view
from p2gs_jax.options.results import Render
from p2gs_jax.photometry.look import develop
from p2gs_jax.progress import TerminalReporter
from p2gs_jax.render.host import make_renderer
from p2gs_jax.run_folder import load_run
from p2gs_jax.scene.device import camera_of
from p2gs_jax.scene.images import ImageStore


def run(options: Render) -> int:
    """Render views of a run as EXR and PNG."""
    split, exposure_ev, gamma = options.split, options.exposure_ev, options.gamma
    if split not in ("all", "train", "test"):
        raise UserError(f"--split {split!r} is unknown.", fix="choose all, train or test")
    if gamma is not None and gamma <= 0:
        raise UserError(f"--gamma {gamma} is not positive.", fix="2.2 is the usual one")
    fitted = load_run(options.run)
    folder = options.out or options.run / "renders" / "all"
    store = ImageStore(fitted.scene.views, fitted.cfg.data)
    render = make_renderer(fitted.cfg.render)
    rows = [i for i, v in enumerate(fitted.scene.views) if split in ("all", v.split)]
    begin = time.monotonic()
    with TerminalReporter() as reporter:
        for done, index in enumerate(rows):
            result = render(fitted.params.gaussians, fitted.alive, camera_of(store, index))
            look = fitted.own_look(index)
            if exposure_ev is not None:
                look = replace(fitted.common_look(exposure_ev), gamma=look.gamma)
            if gamma is not None:
                look = replace(look, gamma=gamma)
            view = ViewResult(
                index,
                np.asarray(result.linear),
                np.asarray(result.alpha),
                np.asarray(result.depth),
                develop(result.linear, look),
                store.get(index, 1)[0],
                look.exposure,
                look.gamma,
            )
            write_view(folder, fitted.scene.views[index].name, view, store)
            reporter.stage("Rendering", done + 1, len(rows))
    stdout().print(f"{len(rows)} views in {time.monotonic() - begin:.1f} s: {folder}")
    return 0
