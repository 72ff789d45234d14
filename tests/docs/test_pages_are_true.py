"""Lists in pages are complete, links resolve, and licences are the installed packages' ones."""

import importlib
import json
import re

import pytest
from pages import PAGES, ROOT, anchors, links

from p2gs_jax.evaluation.scores import PROTOCOLS

DOCS = ROOT / "docs"


def test_the_files_page_names_every_file_and_key_of_a_run(finished_run):
    page = (DOCS / "files.md").read_text(encoding="utf-8")
    metrics = json.loads((finished_run / "metrics.json").read_text())
    photometry = json.loads((finished_run / "photometry.json").read_text())
    keys = set(metrics) | set(metrics["train"]) | set(metrics["test"]) | set(photometry)
    keys |= {key for view in photometry["views"] for key in view}
    keys |= set(metrics["consistency"]) | set(metrics["consistency"]["averaged"])
    missing = keys - set(re.findall(r"\w+", page))
    missing |= {path.name for path in finished_run.iterdir() if f"`{path.name}" not in page}
    assert not missing, "docs/files.md does not name them"


NAMING = [ROOT / "CONTRIBUTING.md", ROOT / "README.md", *sorted(DOCS.glob("*.md"))]


@pytest.mark.parametrize("page", NAMING, ids=lambda page: str(page.relative_to(ROOT)))
def test_modules_and_names_in_pages_exist(page):
    """`folder/file.py:name`, relative to the package except in tests/ and experiments/."""
    found = re.findall(r"`((?:\w+/)*\w+\.py)(?::([\w.]+))?`", page.read_text(encoding="utf-8"))
    for path, name in found:
        if ("/" not in path and not name) or "NAME" in path:
            continue  # a file beside the page, or the user's
        outside = path.startswith(("tests/", "experiments/", "p2gs_jax/", "docs/"))
        file = ROOT / ("" if outside else "p2gs_jax/") / path
        assert file.is_file(), f"there is no {path}"
        module = str(file.relative_to(ROOT).with_suffix("")).removesuffix("/__init__")
        holder = importlib.import_module(module.replace("/", ".")) if name else None
        for part in name.split(".") if name else []:
            assert hasattr(holder, part), f"{path} has no {name}"
            holder = getattr(holder, part)


def test_the_first_page_explains_every_line_that_a_fit_prints():
    page = (DOCS / "quickstart.md").read_text(encoding="utf-8")
    printed = [p for p in PROTOCOLS.values() if p.path[0] != "reference"]
    assert not [p for p in printed if f"| {p.views}, {p.shown} |" not in page]


def test_the_reference_has_every_public_name():
    import p2gs_jax

    text = (DOCS / "reference.md").read_text(encoding="utf-8")
    entries = re.findall(r"^::: ([\w.]+)\.(\w+)$", text, flags=re.M)
    assert set(p2gs_jax.__all__) <= {name for _, name in entries}
    for module, name in entries:
        assert hasattr(importlib.import_module(module), name), f"{module} has no {name}"


FIELD = re.compile(
    r"`((?:data|render|photometry|loss|optimizer|densify|dynamics|init|train)\.[\w.]+)`"
)


def test_the_paper_map_has_every_equation_and_names_fields_that_exist():
    from p2gs_jax import FitConfig

    text = (DOCS / "conventions.md").read_text(encoding="utf-8")
    rows = {int(n) for n in re.findall(r"^\| \((\d+)\)", text, flags=re.M)}
    assert rows == set(range(1, 20))
    for name in FIELD.findall(text):
        value = FitConfig()
        for part in name.split("."):
            assert hasattr(value, part), f"there is no field {name}"
            value = getattr(value, part)


def test_drawings_are_those_of_their_script(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(DOCS / "images"))
    draw = importlib.import_module("draw")
    for name, drawing in draw.DRAWINGS.items():
        drawing().save(tmp_path / name)
        drawn, kept = (tmp_path / name).read_text(), (DOCS / "images" / f"{name}.svg").read_text()
        assert drawn == kept, "run `python docs/images/draw.py`"


LINKED = [*PAGES, ROOT / "BUILD_NOTES.md", *sorted((ROOT / "experiments").rglob("*.md"))]


@pytest.mark.parametrize("page", LINKED, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_resolve(page):
    for target in links(page):
        path, _, anchor = target.partition("#")
        found = (page.parent / path).resolve() if path else page
        assert found.exists(), f"{page.name} links to {target}, which is not there"
        if anchor:
            assert anchor in anchors(found), f"{found.name} has no heading for #{anchor}"


@pytest.mark.parametrize("folder", ["docs", "experiments/results"])
def test_the_index_leads_to_every_page(folder):
    index = ROOT / folder / "README.md"
    reached = {(index.parent / target.partition("#")[0]).resolve() for target in links(index)}
    missing = set((ROOT / folder).rglob("*.md")) - reached - {index}
    assert not missing, f"{index} does not lead to them"


@pytest.fixture
def licences(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    return importlib.import_module("licences")


def test_the_licence_page_is_that_of_its_script(licences):
    text = licences.PAGE.read_text(encoding="utf-8")
    assert text == licences.page(), "run python docs/licences.py"
    assert all(f"| {name} |" in text for name in licences.declared())


def test_no_dependency_is_under_the_gpl_and_packages_that_carry_it_are_named(licences):
    rows = licences.rows()
    assert [name for name, (_, licence, _) in rows.items() if licences.is_gpl(licence)] == []
    marked = {name for name, (_, _, carried) in rows.items() if licences.is_gpl(carried)}
    assert marked == set(licences.WHY)
    assert licences.is_gpl("GNU General Public License v3 (GPLv3+)")
    assert not licences.is_gpl("GNU Lesser General Public License")


def test_the_package_does_not_import_plyfile():
    imported = re.compile(r"^\s*(?:from|import) plyfile\b", re.MULTILINE)
    for path in (ROOT / "p2gs_jax").rglob("*.py"):
        assert not imported.search(path.read_text(encoding="utf-8")), path
