"""A page as PDF, printed by an installed browser."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from pathlib import Path

from p2gs_jax.core.atomic import atomic_write
from p2gs_jax.errors import UserError

BROWSERS = (
    *("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome"),
    *("microsoft-edge", "msedge", "brave-browser"),
    "/Applications/Google Chrome.app/Contents/MacOS/Google Chrome",
    "/Applications/Chromium.app/Contents/MacOS/Chromium",
)
SECONDS = 120


def find_browser() -> str:
    """Return the path of a browser that prints.

    Raises:
        UserError: there is none.
    """
    path = next(filter(None, map(shutil.which, BROWSERS)), None)
    if path is None:
        raise UserError(
            "--pdf needs a Chromium or Chrome, and none is here (looked for "
            f"{', '.join(BROWSERS)}).",
            fix="install one of them, or open the page in any browser and print it from there",
        )
    return path


def print_pdf(page: Path, out: Path, browser: str) -> Path:
    """Print a page.

    Args:
        page: HTML file.
        out: PDF file.
        browser: from `find_browser`.

    Raises:
        UserError: the browser did not print.
    """
    with atomic_write(out) as temporary, tempfile.TemporaryDirectory() as profile:
        command = [
            *(browser, "--headless", "--disable-gpu", "--no-first-run", "--no-pdf-header-footer"),
            *(f"--user-data-dir={profile}", f"--print-to-pdf={temporary}"),
            page.resolve().as_uri(),
        ]
        if hasattr(os, "geteuid") and os.geteuid() == 0:
            command.insert(1, "--no-sandbox")  # Chromium refuses to run as root otherwise
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=SECONDS)
            said = done.stderr.strip().splitlines()[-1:] or [f"exit code {done.returncode}"]
        except (OSError, subprocess.TimeoutExpired) as error:
            said = [str(error)]
        if not temporary.read_bytes().startswith(b"%PDF"):
            raise UserError(
                f"{browser} did not print {page}: {said[0]}",
                fix=f"open {page} in a browser and print it from there",
            )
    return out
