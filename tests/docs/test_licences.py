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
    assert all(f"| {name} |" in text for name in licences.declared())


def test_nothing_that_users_install_is_under_the_gpl_and_what_carries_it_is_named(licences):
    rows = licences.rows()
    assert [name for name, (_, said, _) in rows.items() if licences.is_gpl(said)] == []
    marked = {name for name, (_, _, carried) in rows.items() if licences.is_gpl(carried)}
    assert marked == set(licences.WHY)
    assert licences.is_gpl("GNU General Public License v3 (GPLv3+)")
    assert not licences.is_gpl("GNU Lesser General Public License")


def test_the_program_imports_nothing_of_the_tests():
    imported = re.compile(r"^\s*(?:from|import) plyfile\b", re.MULTILINE)
    for path in (ROOT / "p2gs_jax").rglob("*.py"):
        assert not imported.search(path.read_text(encoding="utf-8")), path
