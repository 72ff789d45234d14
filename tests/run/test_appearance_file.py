"""Learned corrections come back as they were saved, in the order of the views, or are refused."""

import json
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from p2gs_jax.errors import UserError
from p2gs_jax.photometry.appearance import identity
from p2gs_jax.run.photometry_files import read_appearance, write_appearance
from p2gs_jax.types import View

CAMERAS = ("right", "left", "right")


def views():
    pose, K = np.eye(4, dtype=np.float32), np.eye(3, dtype=np.float32)
    return [View(f"{i}.png", Path(), c, pose, K, 4, 4) for i, c in enumerate(CAMERAS)]


def learned(kind):
    rng = np.random.default_rng(0)
    start = identity(kind, CAMERAS)
    noisy = jax.tree.map(lambda x: x + jnp.asarray(rng.normal(size=x.shape), jnp.float32), start)
    return replace(noisy, exposures=start.exposures) if kind == "ppisp" else noisy


JSON = ("ppisp", "luminance")


@pytest.mark.parametrize("kind", ["affine", *JSON])
def test_they_come_back_bit_for_bit(tmp_path, kind):
    path, saved = tmp_path / "file", learned(kind)
    path = path.with_suffix(".json" if kind in JSON else ".npy")
    write_appearance(path, saved, views())
    again = read_appearance(path, kind, views())
    assert jax.tree.structure(again) == jax.tree.structure(saved)
    jax.tree.map(np.testing.assert_array_equal, again, saved)


def test_a_file_says_which_view_and_which_camera(tmp_path):
    path, saved = tmp_path / "ppisp.json", learned("ppisp")
    write_appearance(path, saved, views())
    said = json.loads(path.read_text())
    assert said["views"]["2.png"]["camera"] == "right"
    np.testing.assert_allclose(said["cameras"]["left"]["vignetting"], saved.vignettings[0])
    # A fit that holds out other views reads its own rows.
    one = read_appearance(path, "ppisp", views()[2:])
    assert one.names == ("right",)
    np.testing.assert_array_equal(one.colors[0], saved.colors[2])
    np.testing.assert_array_equal(one.responses[0], saved.responses[1])


@pytest.mark.parametrize("kind", ["affine", *JSON])
def test_what_cannot_belong_is_refused(tmp_path, kind):
    path = tmp_path / ("a.json" if kind in JSON else "a.npy")
    with pytest.raises(UserError, match="cannot be read"):
        read_appearance(path, kind, views())
    path.write_text("{]", encoding="utf-8")
    with pytest.raises(UserError, match="cannot be read"):
        read_appearance(path, kind, views())
    saved = learned(kind)
    write_appearance(path, saved, views())
    other = [*views(), View("new.png", Path(), "left", *(np.eye(4), np.eye(3)), 4, 4)]
    with pytest.raises(UserError, match="does not belong"):
        read_appearance(path, kind, other)
