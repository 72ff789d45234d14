"""Examples of the documentation work: Python runs, commands are parsed, files are read.

`pages.py` describes the directives of blocks. Tests make the preset `robust` quick
(`quick_presets`), so that Python runs unchanged. The working folder has a tiny scene, `scene` and
`street`, and a finished run of it, `RUN` and `runs/street`.
"""

import base64
import contextlib
import dataclasses
import io
import json
import re
import shutil
import tomllib

import cv2
import matplotlib
import numpy as np
import pytest
from pages import LANGUAGES, PAGES, ROOT, blocks, commands, prose
from tiny_scene import make_scene

from p2gs_jax import config, read_sweep
from p2gs_jax.cli import main
from p2gs_jax.cli.fit import Calibrate, Fit
from p2gs_jax.cli.parser import COMMANDS, parse
from p2gs_jax.options import check_values

BLOCKS = [block for page in PAGES for block in blocks(page)]


def blocks_to_run(*languages):
    """Return blocks of some languages that can be tested."""
    return [b for b in BLOCKS if b.language in languages and b.skip is None]


def each(found):
    return pytest.mark.parametrize("block", found, ids=[b.name for b in found])


@pytest.fixture
def quick_presets(monkeypatch):
    """Let `robust` take a few steps at one resolution, with few Gaussians."""
    slow, init = config.FitConfig(), config.FitConfig.__init__
    quick = {
        "data": dataclasses.replace(slow.data, test_every=3),
        "render": dataclasses.replace(slow.render, sh_degree=1),
        "densify": dataclasses.replace(slow.densify, max_gaussians=400),
        "init": dataclasses.replace(slow.init, shell="off"),
        "train": dataclasses.replace(slow.train, steps=10, coarse_to_fine=()),
    }
    monkeypatch.setattr(
        config.FitConfig, "__init__", lambda self, **fields: init(self, **(quick | fields))
    )


@pytest.fixture
def folder(tmp_path, monkeypatch, finished_run):
    make_scene(tmp_path / "scene")
    make_scene(tmp_path / "street")
    for name in ("RUN", "runs/street"):
        shutil.copytree(finished_run, tmp_path / name)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_every_block_has_a_language_that_is_tested():
    assert {block.language for block in BLOCKS} <= set(LANGUAGES)


PYTHON_PAGES = sorted({b.page for b in blocks_to_run("python")})
LONG = {"api.md": pytest.mark.slow}  # several whole fits


@pytest.mark.parametrize(
    "page", [pytest.param(p, id=p.name, marks=LONG.get(p.name, ())) for p in PYTHON_PAGES]
)
def test_python_runs(page, folder, quick_presets):
    """Blocks of a page follow each other in one namespace."""
    namespace = {"__name__": "__main__"}
    for block in blocks_to_run("python"):
        if block.page == page:
            padded = "\n" * (block.line - 1) + block.code  # so that tracebacks name the page's line
            exec(compile(padded, block.page, "exec"), namespace)


@pytest.mark.slow  # a whole fit, and the programs of its export
@pytest.mark.parametrize("path", sorted((ROOT / "examples").glob("*.ipynb")), ids=lambda p: p.name)
def test_notebooks_run_and_are_stored_without_outputs(path, folder, quick_presets):
    """Code cells follow each other in one namespace; lines after `!` are commands."""
    matplotlib.use("Agg")
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    namespace = {"__name__": "__main__", "command": run_of_notebook}
    for number, cell in enumerate(c for c in cells if c["cell_type"] == "code"):
        assert not cell["outputs"]
        assert cell["execution_count"] is None
        code = "".join(cell["source"]).replace('"train.budget_s": 120.0', '"train.steps": 10')
        code = re.sub(r"^!p2gs-jax (.*)$", r'command("\1")', code, flags=re.M)
        exec(compile(code, f"{path.name}, code cell {number}", "exec"), namespace)
    assert (folder / "runs/scene/exports").is_dir()
    solved, run = namespace["solved"], namespace["run"]
    psnr = namespace["result"].metrics["test"]["exposure_fitted"]["psnr"]
    for shown, number in ((solved, f"{solved.observations:,}"), (run, f"{psnr:.2f} dB")):
        html = shown._repr_html_()
        assert number in html
        data = base64.b64decode(re.search(r'src="data:image/png;base64,([^"]+)"', html)[1])
        assert cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR).std() > 10


def run_of_notebook(words):
    with pytest.raises(SystemExit) as stop:
        main(words.split())
    assert stop.value.code == 0, words


@each(blocks_to_run("sh"))
def test_commands_can_be_parsed(block, tmp_path, monkeypatch):
    """Every argument can be parsed; nothing is run."""
    monkeypatch.chdir(tmp_path)
    for words in commands(block.code):
        check_command(words, block.name)


def check_command(words, where):
    program, argv = words[0], words[1:]
    if program == "p2gs-jax":
        check_ours(argv, f"{where}: {' '.join(words)}")
    elif program == "python":
        script = ROOT / argv[0]
        assert script.is_file(), f"{where}: there is no {argv[0]}"
    elif program == "pip":
        extras = re.findall(r"\[([\w,]+)\]", " ".join(argv))
        project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
        for extra in ",".join(extras).split(",") if extras else []:
            assert extra in project["optional-dependencies"], f"{where}: no extra {extra!r}"
    else:
        assert program in ("pytest", "cd", "mkdir", "git"), f"{where}: what is {program!r}?"


def check_ours(argv, where):
    if len(argv) == 1 and argv[0] in COMMANDS:  # the text names a command alone
        return
    try:
        name, options = parse(argv)
    except SystemExit as stop:
        if stop.code:
            pytest.fail(f"{where}: this cannot be parsed")
        return
    assert name in COMMANDS
    if isinstance(options, Fit):
        check_values(options.config)
    if isinstance(options, Calibrate):
        options.checked()


@each(blocks_to_run("toml"))
def test_sweep_files_are_read(block, tmp_path):
    path = tmp_path / "sweep.toml"
    path.write_text(block.code)
    assert read_sweep(path).configs


@each(blocks_to_run("json"))
def test_json_can_be_parsed(block):
    json.loads(block.code)


@pytest.fixture(scope="module")
def options():
    """Return every option of every command."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        for name in COMMANDS:
            with contextlib.suppress(SystemExit):
                parse([name, "--help-all"])
    return set(re.findall(r"--[\w.-]+", out.getvalue()))


# Options of other programs that pages mention.
OTHERS = {"--help", "--help-all", "--version", "--ckpt", "--only", "--nthreads"}
OTHERS |= {"--data", "--orientation-method", "--center-method", "--auto-scale-poses"}
OTHERS |= {"--data_dir", "--data_factor", "--colmap-path", "--mask-mode", "--save-ply", "--center"}
OTHERS |= {"--no-normalize-world-space", "--post_processing", "--train_test_exp"}
OTHERS |= {"--ppisp", "--ppisp-freeze", "--ppisp-sidecar"}


# The history names removed options.
TODAY = [page for page in PAGES if page.name != "CHANGELOG.md"]


@pytest.mark.parametrize("page", TODAY, ids=[str(p.relative_to(ROOT)) for p in TODAY])
def test_options_in_the_text_exist(page, options):
    for span in re.findall(r"`([^`\n]+)`", prose(page)):
        if span.startswith("p2gs-jax ") and "..." not in span and "COMMAND" not in span:
            check_command(span.split(), page.name)
        for option in re.findall(r"(?<!\S)--[a-z][\w.-]*", span):
            known = option.replace("*", "") in options | OTHERS
            group = option.endswith(".") and any(o.startswith(option) for o in options)
            assert known or group, f"{page.name} speaks of {option}, which does not exist"
