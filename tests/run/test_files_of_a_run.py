"""The files of a run folder are read back as they were written, or are refused."""

import json
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from synthetic_drive import make_drive, make_exposures, observe

from p2gs_jax.errors import UserError
from p2gs_jax.photometry.adjustment.fit import fit_model
from p2gs_jax.photometry.adjustment.solve import fit_response
from p2gs_jax.photometry.appearance import identity
from p2gs_jax.photometry.calibrate import CalibrationOptions
from p2gs_jax.photometry.models import Form
from p2gs_jax.photometry.response import Response
from p2gs_jax.run.photometry_files import read_appearance, write_appearance
from p2gs_jax.run.plots import curves_to_draw, write_calibration_plot
from p2gs_jax.run.scene_file import SCENE_FILE, read_scene
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
def test_corrections_are_read_back_bit_for_bit(tmp_path, kind):
    path, saved = tmp_path / "file", learned(kind)
    path = path.with_suffix(".json" if kind in JSON else ".npy")
    write_appearance(path, saved, views())
    again = read_appearance(path, kind, views())
    assert jax.tree.structure(again) == jax.tree.structure(saved)
    jax.tree.map(np.testing.assert_array_equal, again, saved)


def test_rows_of_corrections_are_found_by_view_and_camera(tmp_path):
    path, saved = tmp_path / "ppisp.json", learned("ppisp")
    write_appearance(path, saved, views())
    content = json.loads(path.read_text())
    assert content["views"]["2.png"]["camera"] == "right"
    np.testing.assert_allclose(content["cameras"]["left"]["vignetting"], saved.vignettings[0])
    # A fit that holds out other views reads the rows of its views.
    one = read_appearance(path, "ppisp", views()[2:])
    assert one.names == ("right",)
    np.testing.assert_array_equal(one.colors[0], saved.colors[2])
    np.testing.assert_array_equal(one.responses[0], saved.responses[1])


@pytest.mark.parametrize("kind", ["affine", *JSON])
def test_broken_corrections_and_those_of_other_views_are_refused(tmp_path, kind):
    path = tmp_path / ("a.json" if kind in JSON else "a.npy")
    with pytest.raises(UserError, match="cannot be read"):
        read_appearance(path, kind, views())
    path.write_text("{]", encoding="utf-8")
    with pytest.raises(UserError, match="cannot be read"):
        read_appearance(path, kind, views())
    write_appearance(path, learned(kind), views())
    other = [*views(), View("new.png", Path(), "left", *(np.eye(4), np.eye(3)), 4, 4)]
    with pytest.raises(UserError, match="does not belong"):
        read_appearance(path, kind, other)


def test_a_broken_scene_file_is_refused(tmp_path):
    np.savez_compressed(
        tmp_path / SCENE_FILE,
        json=np.array('{"views": [], "notes": []}'),
        points=np.random.default_rng(0).normal(size=(50, 3)),
    )
    whole = (tmp_path / SCENE_FILE).read_bytes()
    rng = np.random.default_rng(1)
    broken = [b"", b"\0", whole[: len(whole) // 2]]
    for at in rng.choice(len(whole) * 8, 150, replace=False):
        flipped = bytearray(whole)
        flipped[at // 8] ^= 1 << (at % 8)
        broken.append(bytes(flipped))
    for data in broken:
        (tmp_path / SCENE_FILE).write_bytes(data)
        # Even without damage the file does not hold a whole scene.
        with pytest.raises(UserError, match=SCENE_FILE):
            read_scene(tmp_path, tmp_path)


DRIVE = make_drive(12, 400)
PIVOT = 0.18


def draws(path, solution, cameras):
    stated = np.full(len(cameras), np.nan)
    write_calibration_plot(path, solution, cameras=cameras, stated_ev=stated, pivot=PIVOT)
    return path.stat().st_size > 10_000


@pytest.fixture(scope="module")
def problem():
    gains = np.repeat(make_exposures(DRIVE, "iso4")[:, None], 3, 1)
    options = CalibrationOptions(black=4 / 255, saturation=250 / 255, pivot=PIVOT)
    return options.problem(observe(DRIVE, gains))


@pytest.mark.parametrize(
    ("by", "names"),
    [
        ("all", ["gamma 2.20"]),
        ("camera", ["front", "right", "left"]),
        ("channel", ["red", "green", "blue"]),
    ],
)
def test_every_response_of_a_camera_or_channel_is_drawn(tmp_path, recwarn, problem, by, names):
    form = Form("view_exposure")
    solution = fit_model(problem, form, fit_response(problem, Response("srgb"), form=form, by=by))
    assert [name for name, _, _ in curves_to_draw(solution)] == names
    assert draws(tmp_path / "calibration.png", solution, [str(c) for c in DRIVE.cameras])
    # Names of cameras are not formulas.
    hostile = (r"$\nothing$", "\x1b[31m", "写")
    assert draws(tmp_path / "b.png", solution, [hostile[k % 3] for k in range(len(DRIVE.cameras))])
    assert not [str(w.message) for w in recwarn]
