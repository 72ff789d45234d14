"""Pages that list things list all of them, and nothing else."""

import importlib
import json
import re
from pathlib import Path

import pytest
from pages import ROOT

DOCS = ROOT / "docs"


def files_page() -> str:
    return (DOCS / "files.md").read_text(encoding="utf-8")


def test_files_page_knows_what_a_run_folder_holds(finished_run):
    for path in finished_run.iterdir():
        assert f"`{path.name}" in files_page(), "docs/files.md does not speak of it"


def test_files_page_knows_the_keys(finished_run):
    metrics = json.loads((finished_run / "metrics.json").read_text())
    photometry = json.loads((finished_run / "photometry.json").read_text())
    keys = set(metrics) | set(metrics["train"]) | set(metrics["test"]) | set(photometry)
    keys |= {key for view in photometry["views"] for key in view}
    keys |= set(metrics["consistency"]) | set(metrics["consistency"]["averaged"])
    missing = keys - set(re.findall(r"\w+", files_page()))
    assert not missing, "docs/files.md does not speak of them"


PATH = re.compile(r"`([\w.-]+(?:/[\w.-]+)+)(?::(\w+(?:\.\w+)?))?`")


def test_the_map_for_contributors_names_what_exists():
    """Every path of CONTRIBUTING.md but those with NAME, and what they are said to hold."""
    found = PATH.findall((ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8"))
    assert len(found) > 50
    for path, name in found:
        if "NAME" in path or path.startswith("../"):
            continue
        assert (ROOT / path).exists(), f"there is no {path}"
        holder = importlib.import_module(_module(path)) if name else None
        for part in name.split(".") if name else []:
            assert hasattr(holder, part), f"{path} has no {name}"
            holder = getattr(holder, part)


PAGES = [ROOT / "BUILD_NOTES.md", ROOT / "README.md", *sorted(DOCS.glob("*.md"))]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_pages_name_modules_and_what_they_hold(page):
    """`folder/file.py:name`, relative to the package but for tests and experiments."""
    found = re.findall(r"`((?:\w+/)*\w+\.py)(?::([\w.]+))?`", page.read_text(encoding="utf-8"))
    assert page.name not in {"architecture.md", "conventions.md"} or len(found) > 10
    for path, name in found:
        if "/" not in path and not name:
            continue  # beside the page, or a file that a user makes
        outside = path.startswith(("tests/", "experiments/", "p2gs_jax/", "docs/"))
        file = ROOT / ("" if outside else "p2gs_jax/") / path
        assert file.is_file(), f"there is no {path}"
        if name:
            _require_defined(file, name)


def _require_defined(file: Path, name: str) -> None:
    """Require that a module defines a name; one that it only imports has moved."""
    first = name.split(".")[0]
    source = file.read_text(encoding="utf-8")
    defined = re.search(rf"^(?:def|class) {first}\b|^{first}\b.*=", source, flags=re.M)
    assert defined, f"{file.relative_to(ROOT)} does not define {name}"
    holder = importlib.import_module(_module(str(file.relative_to(ROOT))))
    for part in name.split("."):
        assert hasattr(holder, part), f"{file.relative_to(ROOT)} has no {name}"
        holder = getattr(holder, part)


def _module(path: str) -> str:
    return path.removesuffix(".py").removesuffix("/__init__").replace("/", ".")


def test_the_reference_has_every_public_name():
    import p2gs_jax

    text = (DOCS / "reference.md").read_text(encoding="utf-8")
    entries = re.findall(r"^::: ([\w.]+)\.(\w+)$", text, flags=re.M)
    names = {name for _, name in entries}
    assert set(p2gs_jax.__all__) <= names
    for module, name in entries:
        assert hasattr(importlib.import_module(module), name), f"{module} has no {name}"


FIELD = re.compile(r"`((?:data|render|photometry|loss|optimizer|densify|init|train)\.[\w.]+)`")


def test_the_paper_map_names_fields_that_exist():
    from p2gs_jax import FitConfig

    found = FIELD.findall((DOCS / "paper_to_code.md").read_text(encoding="utf-8"))
    assert len(found) > 10
    for name in found:
        value = FitConfig()
        for part in name.split("."):
            assert hasattr(value, part), f"there is no field {name}"
            value = getattr(value, part)


def test_the_paper_map_has_every_equation():
    text = (DOCS / "paper_to_code.md").read_text(encoding="utf-8")
    rows = {int(n) for n in re.findall(r"^\| \((\d+)\)", text, flags=re.M)}
    assert rows == set(range(1, 20))


def test_drawings_are_what_their_script_draws(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(DOCS / "images"))
    draw = importlib.import_module("draw")
    for name, drawing in draw.DRAWINGS.items():
        drawing().save(tmp_path / name)
        drawn, kept = (tmp_path / name).read_text(), (DOCS / "images" / f"{name}.svg").read_text()
        assert drawn == kept, "run `python docs/images/draw.py`"
