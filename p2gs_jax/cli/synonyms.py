"""Names that 3DGS, gsplat and nerfstudio give to our options."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from p2gs_jax.errors import UserError

SCENE = "the scene's folder itself, without an option"
# Their names and ours.
SYNONYMS = {
    "--iterations": "--steps",
    "--iters": "--steps",
    "--max-steps": "--steps",
    "--max-num-iterations": "--steps",
    "--num-iterations": "--steps",
    "--cap-max": "--gaussians",
    "--max-gaussians": "--gaussians",
    "--num-gaussians": "--gaussians",
    "--resolution": "--max-width",
    "--downscale-factor": "--max-width",
    "--data-factor": "--max-width",
    "--output": "--out",
    "--output-dir": "--out",
    "--output-path": "--out",
    "--result-dir": "--out",
    "--model-path": "--out",
    "--eval": "--test-every",
    "--llffhold": "--test-every",
    "--sh-degree": "--render.sh-degree",
    "--white-background": "--background",
    "--background-color": "--background",
    "--random-background": "--background",
    "--timeout": "--budget",
    "--time-limit": "--budget",
    "--image-dir": "--images",
    "--force": "--overwrite",
    "--exposure": "--exposure-ev",
    "--ev": "--exposure-ev",
    "--source-path": SCENE,
    "--data": SCENE,
    "--data-dir": SCENE,
}


def check_option_names(command: str, argv: Sequence[str], options: Collection[str]) -> None:
    """Reject options of other programs, and name ours.

    Args:
        command: name of the command.
        argv: its arguments.
        options: names of the command's own options, such as `--max-width`.

    Raises:
        UserError: there is an option of another program.
    """
    for word in argv:
        name = word.split("=", 1)[0].replace("_", "-")
        ours = SYNONYMS.get(name)
        if ours is None or name in options:
            continue
        if ours is SCENE and command == "fit":
            fix = f"name {SCENE}: p2gs-jax fit SCENE --out RUN"
        elif ours in options or (ours.startswith("--render.") and "--config" in options):
            fix = f"here it is called {ours}"
        else:
            continue
        raise UserError(f"p2gs-jax {command} has no option {name}.", fix=fix)
