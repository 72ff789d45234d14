"""experiments/reliability: records, the page, and that guards exist."""

import importlib
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "experiments"))

from reliability.family import Failure, Family, Mended
from reliability.page import page, write_page
from reliability.record import Entry, newest_entries, write_entry

ROOT = Path(__file__).parents[2]
RELIABILITY = ROOT / "experiments" / "reliability"
FOUND = Family(
    "broken",
    10,
    9,
    (Failure("<b>|", "a `tick`"),),
    (Mended("it hung", "tests/a.py::test_b"),),
    "run",
    2.0,
    ({"name": "x", "EV": 1.5},),
)
FAMILIES = sorted(p.stem for p in (RELIABILITY / "families").glob("[!_]*.py"))


def entry(date="2026-01-01", quick=False, tried=10, name="broken"):
    return Entry(Family(name, tried, tried), date, "abc", quick)


def test_an_entry_comes_back_as_it_was_written(tmp_path):
    written = Entry(FOUND, "2026-01-01", "abc", False)
    write_entry(tmp_path, written)
    assert newest_entries(tmp_path) == {"broken": written}


def test_families_share_a_record_and_replace_their_own(tmp_path):
    for tried, name in ((1, "a"), (2, "b"), (3, "a")):
        write_entry(tmp_path, entry(tried=tried, name=name))
    found = newest_entries(tmp_path)
    assert {n: e.family.tried for n, e in found.items()} == {"a": 3, "b": 2}
    assert len(list(tmp_path.iterdir())) == 1


def test_a_part_never_replaces_the_whole(tmp_path):
    write_entry(tmp_path, entry())
    write_entry(tmp_path, entry(quick=True, tried=2))
    write_entry(tmp_path, entry("2026-01-02", quick=True, tried=2))
    assert newest_entries(tmp_path)["broken"].family.tried == 10
    write_entry(tmp_path, entry("2026-01-02", tried=12))
    assert newest_entries(tmp_path)["broken"].family.tried == 12


def test_the_page_counts_names_failures_and_escapes(tmp_path):
    write_entry(tmp_path, Entry(FOUND, "2026-01-01", "abc", False))
    write_entry(tmp_path, entry(name="gone"))
    write_page(tmp_path / "page.md", tmp_path, {"broken": "What breaks. And more."})
    text = (tmp_path / "page.md").read_text()
    assert "| [broken](#broken) | What breaks | 10 | 9 | 1 |" in text
    assert "\\<b\\>\\|" in text
    assert "a \\`tick\\`" in text
    assert "it hung (`tests/a.py::test_b`)" in text
    assert "gone" not in text
    assert "None." in page({"gone": entry(name="gone")}, {"gone": "It."})


@pytest.mark.parametrize("name", FAMILIES)
def test_families_keep_the_contract_and_their_guards_exist(name):
    module = importlib.import_module(f"reliability.families.{name}")
    assert name == module.NAME
    assert module.ABOUT
    assert callable(module.run)
    for mended in getattr(module, "MENDED", ()):
        path, _, test = mended.test.partition("::")
        source = (ROOT / path).read_text(encoding="utf-8")
        assert not test or f"def {test}(" in source, f"{path} has no {test}"
