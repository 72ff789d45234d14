"""The scripts of experiments/, without a fit: imports, their contract and the page."""

import importlib
import json
from pathlib import Path

import published_rows
import pytest
import write_page
from reliability import run as reliability
from reliability.families.safety import PACKAGE, unsafe_calls

ROOT = Path(__file__).parents[2] / "experiments"


@pytest.mark.parametrize("path", sorted(ROOT.glob("*.py")), ids=lambda path: path.stem)
def test_every_script_can_be_imported(path):
    assert importlib.import_module(path.stem).__doc__


def test_every_family_has_a_name_a_text_and_a_function():
    for name, module in reliability.families().items():
        assert name == module.NAME
        assert module.ABOUT
        assert callable(module.run)


def test_the_package_calls_nothing_unsafe(tmp_path):
    assert unsafe_calls(PACKAGE) == []
    calls = ("eval(x)", "pickle.load(f)", "np.load(p)", "subprocess.run(x, shell=True)")
    for number, call in enumerate(calls):
        (tmp_path / f"{number}.py").write_text(f"{call}\n")
    (tmp_path / "safe.py").write_text("np.load(p, allow_pickle=False)\nsubprocess.run([x])\n")
    assert len(unsafe_calls(tmp_path)) == 4


def test_the_page_in_the_repository_follows_from_its_rows():
    rows = published_rows.read_rows() | published_rows.read_rows(write_page.AT_SIZE)
    published = json.loads((published_rows.HERE / "published.json").read_text(encoding="utf-8"))
    assert write_page.OUT.read_text(encoding="utf-8") == write_page.page(published, rows)
