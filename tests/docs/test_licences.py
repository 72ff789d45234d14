"""docs/licences.md names what pyproject.toml declares, under the licences that are installed."""

import importlib

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


def test_what_is_under_the_gpl_is_named(licences):
    marked = {
        name
        for name, (_, licence, carried) in licences.rows().items()
        if licences.is_gpl(licence) or licences.is_gpl(carried)
    }
    assert marked == set(licences.WHY)
    assert "plyfile" in marked


@pytest.mark.parametrize(
    ("text", "gpl"),
    [
        *((text, True) for text in ("GPL-3.0-or-later", "GNU General Public License v3 (GPLv3+)")),
        *((text, False) for text in ("LGPL-2.1", "MIT", "GNU Lesser General Public License")),
    ],
)
def test_the_lesser_is_another(licences, text, gpl):
    assert licences.is_gpl(text) == gpl
