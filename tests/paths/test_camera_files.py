"""Camera files are read back as they were written, and wrong entries are named."""

import json

import numpy as np
import pytest
from cameras import shot, turned

from p2gs_jax.errors import UserError
from p2gs_jax.paths.files import read_cameras, write_cameras

GOOD = {
    "viewmat": np.eye(4).tolist(),
    "K": [[50, 0, 32], [0, 50, 24], [0, 0, 1]],
    "width": 64,
    "height": 48,
}


def save(path, value):
    path.write_text(json.dumps(value))
    return path


def test_cameras_are_read_back_as_they_were_written(tmp_path):
    shots = [
        shot(turned(20, (1, 2, 3), pitch=5), "a/first"),
        shot(turned(), "second", exposure_ev=-1.5, gamma=1.8, view=3),
    ]
    write_cameras(tmp_path / "cameras.json", shots)
    back = read_cameras(tmp_path / "cameras.json")
    for before, after in zip(shots, back, strict=True):
        np.testing.assert_allclose(after.viewmat, before.viewmat, atol=1e-12)
        np.testing.assert_array_equal(after.K, before.K)
        for field in ("name", "width", "height", "exposure_ev", "gamma"):
            assert getattr(after, field) == getattr(before, field)
    assert back[1].view is None
    # Entries without a name are named by their numbers.
    unnamed = read_cameras(save(tmp_path / "c.json", [GOOD, GOOD]))
    assert [s.name for s in unnamed] == ["00000", "00001"]


# Refused values of a field (`...`: the field is missing) by words of the error.
WRONG = {
    "no viewmat": ("viewmat", ...),
    "no K": ("K", ...),
    "K without positive": ("K", [[0, 0, 1], [0, 50, 1], [0, 0, 1]]),
    "skew": ("K", [[50, 3, 32], [0, 50, 24], [0, 0, 1]]),
    "unknown field 'exposure'": ("exposure", 2),
    "viewmat": ("viewmat", None, [[1, 2], [3, 4]], (2 * np.eye(4)).tolist()),
    "has a viewmat": ("viewmat", np.diag([1.0, 1, -1, 1]).tolist()),
    "width": ("width", ..., 0, 64.5, True),
    "a number that is too large": ("time", 10**400),
    "K that is not": ("K", [[10**400, 0, 32], [0, 50, 24], [0, 0, 1]]),
    "not a valid file name": ("name", "\ud800", "a" * 300),
    "lists the pictures": ("name", "cameras.json/a"),
    "height": ("height", ..., "48", 1e300),
    "gamma": ("gamma", 0),
    "exposure_ev": ("exposure_ev", "bright", 5000),
    "name": ("name", "../../etc", "/a", "a\0b", 3),
}
CASES = [(field, value, words) for words, (field, *some) in WRONG.items() for value in some]


@pytest.mark.parametrize(("field", "value", "words"), CASES)
def test_errors_name_the_entry_and_the_field(tmp_path, field, value, words):
    entry = {k: v for k, v in {**GOOD, field: value}.items() if v is not ...}
    path = save(tmp_path / "c.json", [GOOD, entry])
    with pytest.raises(UserError) as error:
        read_cameras(path)
    assert "camera 1" in str(error.value)
    assert words in str(error.value)
    assert str(path) in str(error.value)


def test_invalid_and_missing_files_and_equal_names_are_refused(tmp_path):
    for content in (3, [], [3], {"camera_path": 3}):
        with pytest.raises(UserError, match=r"c\.json"):
            read_cameras(save(tmp_path / "c.json", content))
    with pytest.raises(UserError, match=r"nowhere\.json"):
        read_cameras(tmp_path / "nowhere.json")
    twice = [{**GOOD, "name": "x"}, GOOD, {**GOOD, "name": "./x"}]
    with pytest.raises(UserError, match="0 and 2"):
        read_cameras(save(tmp_path / "c.json", twice))
    nested = [{**GOOD, "name": name} for name in ("a", "a.png/b")]
    with pytest.raises(UserError, match=r"camera 1 has the name 'a\.png/b', whose"):
        read_cameras(save(tmp_path / "c.json", nested))
