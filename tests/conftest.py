"""Shared fixtures; real data is used where it lies beside the checkout and skipped elsewhere."""

import os
import shutil
import tempfile
from pathlib import Path

import pytest

# Programs compiled by one test or its child processes serve the others of the session; a fresh
# session compiles everything once.
_COMPILED = tempfile.TemporaryDirectory(prefix="p2gs-compiled-")
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", _COMPILED.name)
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.1")

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture
def shared_data():
    """Return a function from a data-set name to its folder, skipping where it is absent."""

    def find(name: str) -> Path:
        folder = SHARED / name
        if not folder.is_dir():
            pytest.skip(f"real data set {name!r} is not beside this checkout ({folder})")
        return folder

    return find


@pytest.fixture(scope="session")
def finished_run(tmp_path_factory) -> Path:
    """Return the folder of a small finished `robust` run; copy it before writing to it."""
    from tiny_scene import make_scene

    from p2gs_jax.cli import main

    root = tmp_path_factory.mktemp("finished")
    argv = [
        *("fit", str(make_scene(root / "scene")), "--out", str(root / "run")),
        *("--steps", "60", "--train.coarse-to-fine", "--test-every", "3"),
        *("--densify.max-gaussians", "400", "--render.sh-degree", "1", "--init.shell", "off"),
    ]
    with pytest.raises(SystemExit) as stop:
        main(argv)
    assert stop.value.code == 0
    return root / "run"


CHROMIUM = ("chromium", "chromium-browser", "google-chrome")


@pytest.fixture(scope="session")
def browser():
    """Return a headless Chromium (playwright's `Browser`), skipping where there is none."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    path = next(filter(None, map(shutil.which, CHROMIUM)), None)
    if path is None:
        pytest.skip(f"no browser: none of {', '.join(CHROMIUM)} is on the PATH")
    # The viewer draws with WebGL, which without a GPU needs the software rasterizer.
    args = ["--no-sandbox", "--enable-unsafe-swiftshader"]
    with sync_api.sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=path, args=args)
        yield chromium
        chromium.close()
