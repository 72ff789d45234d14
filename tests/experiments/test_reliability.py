"""experiments/reliability: families keep their contract, and records their entries."""

import importlib
import json
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "experiments"))

from reliability import run
from reliability.family import Family

FAMILIES = sorted(p.stem for p in (run.HERE / "families").glob("[!_]*.py"))


def test_a_part_never_replaces_the_whole(tmp_path, monkeypatch):
    monkeypatch.setattr(run, "HERE", tmp_path)
    for name, tried, quick in (("b", 1, False), ("a", 2, False), ("a", 3, True), ("b", 4, False)):
        run.record(Family(name, tried, tried), quick)
    (path,) = tmp_path.iterdir()
    found = {e["family"]["name"]: e["family"]["tried"] for e in json.loads(path.read_text())}
    assert found == {"a": 2, "b": 4}


@pytest.mark.parametrize("name", FAMILIES)
def test_families_keep_the_contract(name):
    module = importlib.import_module(f"reliability.families.{name}")
    assert name == module.NAME
    assert module.ABOUT
    assert callable(module.run)
