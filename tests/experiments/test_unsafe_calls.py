"""The package runs no text and unpickles no file freely."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2] / "experiments"))

from reliability.families.safety import PACKAGE, TRUSTED, unsafe_calls


def test_the_package_calls_nothing_unsafe():
    assert unsafe_calls(PACKAGE) == list(TRUSTED)


def test_unsafe_calls_are_found(tmp_path):
    for number, call in enumerate(
        ("eval(x)", "pickle.load(f)", "np.load(p)", "subprocess.run(x, shell=True)")
    ):
        (tmp_path / f"{number}.py").write_text(f"{call}\n")
    (tmp_path / "safe.py").write_text("np.load(p, allow_pickle=False)\nsubprocess.run([x])\n")
    assert len(unsafe_calls(tmp_path)) == 4
