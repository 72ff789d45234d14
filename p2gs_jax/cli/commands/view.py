"""`p2gs-jax view`."""

from __future__ import annotations

from p2gs_jax.cli.commands.console import stdout
from p2gs_jax.cli.options.parse import check
from p2gs_jax.cli.options.view import View
from p2gs_jax.errors import UserError
from p2gs_jax.run.read import load_run


def run(options: View) -> int:
    """Show a run in the browser until Ctrl-C."""
    try:
        from p2gs_jax.viewer.server import check_address, serve
    except ModuleNotFoundError as error:
        if error.name is None or error.name.split(".")[0] != "viser":
            raise
        raise UserError(
            "the viewer needs viser, which is not installed.",
            fix="pip install 'p2gs-jax[viewer]'",
        ) from None
    check(options.max_width >= 64, "--max-width must be at least 64")
    check_address(options.host, options.port)
    fitted = load_run(options.run, options.scene)
    serve(
        fitted,
        host=options.host,
        port=options.port,
        max_width=options.max_width,
        say=lambda text: stdout().print(text, highlight=False, soft_wrap=True),
    )
    return 0
