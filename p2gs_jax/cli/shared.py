"""Types, parsers and checks of options that several commands have."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Literal

import tyro

from p2gs_jax.errors import UserError
from p2gs_jax.options import DURATIONS

MeteringRule = Literal["auto", "log_average", "centre", "highlights", "protected"]
RunPath = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(help="Run folder.")]
RunOrSplats = Annotated[
    Path,
    tyro.conf.Positional,
    tyro.conf.arg(help="Run folder; or a file of splats, with --photometry and --scene."),
]
SceneFolder = Annotated[
    Path | None,
    tyro.conf.arg(metavar="DIR", help="Scene of the run, where it has moved since the fit."),
]
PhotometryFolder = Annotated[
    Path | None,
    tyro.conf.arg(metavar="DIR", help="Output of `calibrate --develop`, for splats trained on it."),
]
SCENE = "the scene's folder itself, without an option"
# Our names for commands and options of 3DGS, gsplat and nerfstudio.
COMMANDS_OF_OTHERS = {
    **dict.fromkeys(("train", "simple_trainer"), "fit SCENE"),
    "viewer": "view RUN",
    "metrics": "eval RUN",
}
OTHERS = {
    "--steps": "--iterations --iters --max-steps --max-num-iterations --num-iterations",
    "--gaussians": "--cap-max --max-gaussians --num-gaussians",
    "--max-width": "--resolution --downscale-factor --data-factor -r",
    "--out": "--output --output-dir --output-path --result-dir --model-path -m -o",
    "--test-every": "--eval --llffhold",
    "--render.sh-degree": "--sh-degree",
    "--background": "--white-background --background-color --random-background -w",
    "--budget": "--timeout --time-limit",
    "--images": "--image-dir -i",
    "--overwrite": "--force",
    "--exposure-ev": "--exposure --ev",
    SCENE: "--source-path --data --data-dir -s",
}
SYNONYMS = {theirs: ours for ours, names in OTHERS.items() for theirs in names.split()}
INSTALL_VIEWER = "pip install 'p2gs-jax[viewer]'"


def parse_duration(text: str) -> float:
    """Return the seconds of `90`, `90s`, `5m` or `1h30m`; UserError: anything else."""
    number = r"([0-9]{1,9}(?:\.[0-9]+)?)"
    match = re.fullmatch(rf"(?:{number}h)?(?:{number}m)?(?:{number}s)?|{number}", text.strip())
    if match is None or not match.group():
        raise UserError(f"{text!r} is not a valid duration.", fix=DURATIONS)
    hours, minutes, seconds, bare = (float(n or 0) for n in match.groups())
    return 3600 * hours + 60 * minutes + seconds + bare


def check(condition: bool, text: str, *, fix: str | None = None) -> None:
    """Raise a UserError unless the condition holds."""
    if not condition:
        raise UserError(text + ".", fix=fix)


def has_viewer() -> bool:
    """Return whether the libraries of the viewer are installed."""
    return find_spec("viser") is not None


def require_viewer() -> None:
    """Raise a UserError unless the libraries of the viewer are installed."""
    check(has_viewer(), "the viewer needs viser, which is not installed", fix=INSTALL_VIEWER)


def check_option_names(command: str, argv: Sequence[str], options: Collection[str]) -> None:
    """Raise a UserError for another program's option that is not in `options`; it names ours."""
    for word in argv:
        name = word.split("=", 1)[0].replace("_", "-")
        ours = SYNONYMS.get(name)
        if ours is None or name in options:
            continue
        if ours is SCENE and command == "fit":
            fix = f"name {SCENE}: p2gs-jax fit SCENE"
        elif ours in options or (ours.startswith("--render.") and "--config" in options):
            fix = f"here it is called {ours}"
        else:
            continue
        raise UserError(f"p2gs-jax {command} has no option {name}.", fix=fix)
