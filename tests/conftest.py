"""Shared fixtures; real data is used where it lies beside the checkout and skipped elsewhere."""

import gc
import importlib.metadata
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from filelock import FileLock

# All tests, their child processes and later sessions share compiled programs.
COMPILED = Path(__file__).parents[1] / ".pytest_cache" / "xla"
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(COMPILED))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
# Tests run side by side already; `fit` would divide a view over all cores.
os.environ.setdefault("JAX_NUM_CPU_DEVICES", "1")
# Processes of a test run share Python's bytecode as well.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False
# Each session first cuts the cache to this: JAX's bound looks at every file at every write.
MOST_CACHED_GB = 2.0


def pytest_sessionstart(session):
    """Remove the programs that were compiled the longest ago."""
    kept = 0.0
    if not hasattr(session.config, "workerinput"):
        for path in sorted(COMPILED.glob("*"), key=os.path.getmtime, reverse=True):
            kept += path.stat().st_size / 1e9
            if kept > MOST_CACHED_GB:
                path.unlink(missing_ok=True)


# The slowest files begin first, so that no process is idle at the end. The second file does not
# wait for the run that the first one fits for all.
LONGEST = (
    *("train/test_presets", "faults/test_faults", "jobs/test_sweep", "pipeline/test_moving"),
    *("docs/test_code_blocks", "cli/test_against", "render/test_rasterize", "jobs/test_fit_blocks"),
    *("train/test_step_blocks", "gaussians/test_bake", "pipeline/test_cutouts"),
    *("pipeline/test_calibrate", "train/test_make_step"),
    *("synth/test_street", "pipeline/test_preflight", "render/test_transformations"),
    *("render/test_hard_cases", "viewer/test_browser", "export/test_page_browser"),
)


def pytest_collection_modifyitems(items):
    """Sort the slowest files first, each in one piece."""
    places = {f"tests/{name}.py": place for place, name in enumerate(LONGEST)}
    items.sort(key=lambda item: places.get(item.nodeid.partition("::")[0], len(places)))
    # Imported modules and tests stay: the garbage collector need not visit them.
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def _signals_as_in_a_terminal():
    """Restore signals that processes behind nohup, or of a shell in the background, ignore."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for name in ("SIGTERM", "SIGHUP"):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_DFL)


@pytest.fixture(scope="module", autouse=True)
def _forget_programs():
    """Drop compiled programs after a file if the processes of the run fill half of the memory."""
    yield
    from p2gs_jax.core.memory import resident

    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if resident() > 0.5 * memory / workers:
        import jax

        jax.clear_caches()
        gc.collect()


# Programs of tests run once or twice: XLA compiles them with the least effort. The bench
# in `.ci/run` measures the renderer with the users' options.
EFFORT = {
    "xla_backend_optimization_level": 0,
    "xla_llvm_disable_expensive_passes": True,
    # Processes of a test run share the cores already: threads of one compilation only wait.
    "xla_cpu_parallel_codegen_split_count": 1,
    "xla_cpu_multi_thread_eigen": False,
}
# JAX 0.11 has no such option, and ends at once where it is set.
if importlib.metadata.version("jax").split(".")[:2] == ["0", "10"]:
    EFFORT["xla_cpu_use_fusion_emitters"] = False
if "XLA_FLAGS" not in os.environ:
    os.environ["XLA_FLAGS"] = " ".join(f"--{k}={str(v).lower()}" for k, v in EFFORT.items())


def pytest_configure():
    """Compile everything with the same effort, few sizes of lists and no copies of loops."""
    from p2gs_jax.render import capacity, xla_cpu
    from p2gs_jax.synth import tracer

    xla_cpu._CPU_OPTIONS = EFFORT
    capacity.SMALLEST = 2**15
    tracer._UNROLL = 1


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


@pytest.fixture
def hostile(tmp_path, monkeypatch):
    """Go to a folder on the path whose modules write a file on import; return that file's path."""
    folder, ran = tmp_path / "hostile", tmp_path / "ran"
    folder.mkdir()
    for name in ("cv2", "jax", "numpy", "email", "sitecustomize"):
        (folder / f"{name}.py").write_text(f"open({str(ran)!r}, 'w')")
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend(folder)
    return ran


@pytest.fixture
def run_command(capsys):
    """Return a function from a command line to its exit status and printed text.

    Whatever happens, users see no traceback.
    """
    from p2gs_jax.cli import main

    def run(*argv):
        with pytest.raises(SystemExit) as stop:
            main([str(a) for a in argv])
        out = capsys.readouterr()
        assert "Traceback" not in out.err + out.out
        return stop.value.code, out.err + out.out

    return run


def _ending_with(status):
    """Return a fixture: a function from a command line, which must end so, to its printed text."""

    @pytest.fixture
    def ended(run_command):
        def run(*argv):
            code, text = run_command(*argv)
            assert code == status, text
            return text

        return run

    return ended


succeeded, refused = _ending_with(0), _ending_with(2)


@pytest.fixture(scope="session")
def python():
    """Return a function that runs Python to its end, which must have a status, and returns it.

    `more` are variables beside those of the environment.
    """

    def run(*argv, status=0, env=None, cwd=None, **more):
        command, env = [sys.executable, *map(str, argv)], dict(env or os.environ) | more
        done = subprocess.run(command, env=env, cwd=cwd, capture_output=True, text=True)
        assert done.returncode == status, done.stdout + done.stderr
        return done

    return run


@pytest.fixture(scope="session")
def made_once(tmp_path_factory, request):
    """Return a function that makes a folder once for all processes of a test run.

    Such a folder takes seconds to make, and xdist's processes share no fixtures.
    """
    base = tmp_path_factory.getbasetemp()
    shared = base.parent if hasattr(request.config, "workerinput") else base

    def folder(name: str, make: Callable[[Path], None]) -> Path:
        root, done = shared / name, shared / f"{name}.done"
        with FileLock(shared / f"{name}.lock"):
            if not done.exists():
                shutil.rmtree(root, ignore_errors=True)
                make(root)
                done.touch()
        return root

    return folder


@pytest.fixture(scope="session")
def noisy_street(made_once) -> Path:
    """Return a small street whose cameras chose different ISO values; only to be read."""
    from p2gs_jax.synth.write import write_street

    size = {"frames": 5, "width": 192, "height": 128, "points": 6000, "supersample": 1}
    return made_once("noisy_street", lambda root: write_street(root, **size, iso_std=4.0, seed=3))


@pytest.fixture(scope="session")
def finished_run(made_once) -> Path:
    """Return the folder of a small finished `robust` run; copy it before writing to it."""
    return made_once("finished", _fit_small_scene) / "run"


@pytest.fixture(scope="session")
def camera_run(made_once, finished_run) -> Path:
    """Return `finished_run` with vignetting of its camera and white balance of views; only read it.

    Training view k has the gains 2^(k/10), 1 and 2^(-k/10) relative to green.
    """
    return made_once("camera", lambda root: _with_cameras(finished_run, root / "run")) / "run"


def _with_cameras(finished: Path, run: Path) -> None:
    import json

    shutil.copytree(finished, run)
    saved = json.loads((run / "photometry.json").read_text())
    rows = [[-0.5, 0.1, 0.0], [-0.4, 0.0, 0.0], [-0.3, 0.0, 0.05]]
    for k, view in enumerate(v for v in saved["views"] if v["split"] == "train"):
        view["white_balance"] = [2 ** (k / 10), 1.0, 2 ** (-k / 10)]
        view["white_balance_ev_error"] = [0.01, 0.02, 0.01]
    name = saved["views"][0]["camera"]
    shade = {"vignetting": rows, "corner": [0.67, 0.67, 0.78], "corner_ev_error": [0.02] * 3}
    saved["cameras"] = [{"name": name, **shade, "splines": None}]
    (run / "photometry.json").write_text(json.dumps(saved))
    decided = json.loads((run / "decisions.json").read_text())
    decided |= {"white_balance": "view", "vignetting": "channel"}
    decided["cameras"] = [{"name": name, "vignetting": rows, "splines": []}]
    (run / "decisions.json").write_text(json.dumps(decided))


def _fit_small_scene(root: Path) -> None:
    from tiny_scene import make_scene

    from p2gs_jax import fit, preset, with_fields

    fields = {"train.steps": 60, "train.coarse_to_fine": (), "data.test_every": 3}
    fields |= {"densify.max_gaussians": 400, "render.sh_degree": 1, "init.shell": "off"}
    fields |= {"render.pixels_in_flight": 2048}
    fit(make_scene(root / "scene"), root / "run", with_fields(preset("robust"), fields))


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
