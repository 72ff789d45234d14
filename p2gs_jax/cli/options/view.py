"""`view`: the viewer of a finished run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from p2gs_jax.cli.options.scene import SceneFolder


@dataclass(frozen=True)
class View:
    """Walk through a finished run in the browser, at any exposure.

    p2gs-jax view runs/street
    """

    run: Annotated[Path, tyro.conf.Positional]
    """Run folder."""
    scene: SceneFolder = None
    """Where the run's scene lies now, if it is not where it was."""
    port: int = 8080
    """Port to listen on; 0 takes any free one."""
    host: str = "127.0.0.1"
    """Address to listen on. Other machines reach it only where this is changed, to 0.0.0.0 for
    instance; whoever has the printed address with its token may then look, over plain HTTP."""
    max_width: int = 1920
    """Widest picture that is rendered, pixels; wider windows enlarge it."""
