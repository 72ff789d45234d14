"""Which drive of a folder is read."""

from pathlib import Path

import pytest

from p2gs_jax.errors import UserError
from p2gs_jax.scene.drives.tables import chosen_drive

ROOT = Path("set")
THERE = ["scene-0061", "scene-0103", "scene-01"]


def test_the_only_one_need_not_be_named():
    assert chosen_drive(None, ["a"], ROOT) == "a"


def test_a_name_may_be_cut_short_unless_it_is_one():
    assert chosen_drive("scene-00", THERE, ROOT) == "scene-0061"
    assert chosen_drive("scene-01", THERE, ROOT) == "scene-01"


@pytest.mark.parametrize(
    ("asked", "there", "words"),
    [
        (None, THERE, "holds 3 drives: scene-0061, scene-01, scene-0103"),
        ("scene", THERE, "3 drives of set begin with 'scene'"),
        ("other", THERE, "no drive 'other'; there are scene-0061"),
        ("other", [], "there are none"),
        (None, [str(i) for i in range(9)], "0, 1, 2, 3, 4, ..."),
    ],
)
def test_otherwise_the_names_are_listed(asked, there, words):
    with pytest.raises(UserError, match="--drive NAME") as error:
        chosen_drive(asked, there, ROOT)
    assert words in error.value.message
