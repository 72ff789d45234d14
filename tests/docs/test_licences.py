"""docs/licences.md names what pyproject.toml declares, under the licences that are installed."""

import importlib
import re

import pytest
from pages import ROOT


@pytest.fixture
def licences(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    return importlib.import_module("licences")


def test_the_page_is_what_its_script_writes(licences):
    text = licences.PAGE.read_text(encoding="utf-8")
    assert text == licences.page(), "run python docs/licences.py"
    for name in licences.declared():
        assert f"| {name} |" in text


def marked(licences):
    return {
        name
        for name, (_, licence, carried) in licences.rows().items()
        if licences.is_gpl(licence) or licences.is_gpl(carried)
    }


def test_what_is_under_the_gpl_is_named(licences):
    assert marked(licences) == set(licences.WHY)


def test_nothing_that_users_install_is_under_the_gpl_itself(licences):
    itself = [name for name, (_, said, _) in licences.rows().items() if licences.is_gpl(said)]
    assert itself == []


def test_a_requirement_under_the_gpl_would_be_found(licences, monkeypatch):
    monkeypatch.setattr(licences, "declared", lambda: {"numpy": "everything", "plyfile": "all"})
    assert marked(licences) == {"plyfile"}


def test_the_program_imports_nothing_of_the_tests():
    imported = re.compile(r"^\s*(?:from|import) plyfile\b", re.MULTILINE)
    assert imported.search((ROOT / "tests/core/test_ply_table.py").read_text())
    for path in (ROOT / "p2gs_jax").rglob("*.py"):
        assert not imported.search(path.read_text(encoding="utf-8")), path


@pytest.mark.parametrize(
    ("text", "gpl"),
    [
        *((text, True) for text in ("GPL-3.0-or-later", "GNU General Public License v3 (GPLv3+)")),
        *((text, False) for text in ("LGPL-2.1", "MIT", "GNU Lesser General Public License")),
    ],
)
def test_the_lesser_is_another(licences, text, gpl):
    assert licences.is_gpl(text) == gpl
