"""The tests notice deliberate faults (apply.py); that the list fits the code is checked always."""

import pytest
from apply import ROOT, noticed
from faults import FAULTS


@pytest.mark.parametrize("fault", FAULTS, ids=lambda f: f.name)
def test_the_fault_fits_the_code(fault):
    text = (ROOT / "p2gs_jax" / fault.file).read_text(encoding="utf-8")
    assert text.count(fault.right) == 1
    path = ROOT / "tests" / fault.caught_by.split("::")[0]
    assert path.is_file()
    if "::" in fault.caught_by:
        assert f"def {fault.caught_by.split('::')[1]}(" in path.read_text(encoding="utf-8")


@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS, ids=lambda f: f.name)
def test_the_fault_is_noticed(fault):
    assert noticed(fault)
