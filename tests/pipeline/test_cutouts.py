"""A fit of photographs with alpha, from the folder to the scores."""

import shutil

import cv2
import numpy as np
import pytest
from scene.helpers import write_blender

from p2gs_jax import UserError, fit, load_run, preset, with_fields
from p2gs_jax.evaluation.against import check_renders, judge_renders
from p2gs_jax.evaluation.evaluate import Judge
from p2gs_jax.evaluation.renders_of_others import find_renders
from p2gs_jax.formats.exr import read_exr, write_exr

SIZE, COLOR = 48, np.array([0.8, 0.3, 0.2])


def write_ball(path):
    """Write a view of a ball of one colour and radius 1 at the origin, from a distance of 4."""
    fine = 4 * SIZE
    focal = 0.5 * fine / np.tan(0.35)
    y, x = np.mgrid[:fine, :fine] + 0.5 - fine / 2
    # A ray meets the ball where its angle to the axis has a sine of less than 1 / 4.
    inside = np.sin(np.arctan(np.hypot(x, y) / focal)) < 0.25
    alpha = inside.reshape(SIZE, 4, SIZE, 4).mean((1, 3))
    rgba = np.concatenate([np.broadcast_to(COLOR, (SIZE, SIZE, 3)), alpha[..., None]], 2)
    assert cv2.imwrite(str(path), np.rint(255 * rgba).astype(np.uint8)[..., [2, 1, 0, 3]])


SHORT = {"data.background": "0.1,0.9,0.1", "init.dense": "off", "densify.max_gaussians": 600}
SHORT |= {"train.steps": 60, "train.coarse_to_fine": ()}
SHORT |= {"render.sh_degree": 0, "render.pixels_in_flight": 2048}


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    """Return result and run of a short fit of a ball over green, from random seeds."""
    root = write_blender(tmp_path_factory.mktemp("ball"), write_ball, train=12, test=4)
    return fit(root, root / "run", with_fields(preset("robust"), SHORT)), load_run(root / "run")


def test_held_out_views_of_the_data_set_are_scored_over_the_background(ball):
    result, run = ball
    assert result.metrics["split"] == "transforms_test.json"
    assert sorted(result.metrics["test"]["averaged"]["per_view"]) == [
        f"test/r_{k}.png" for k in range(4)
    ]
    assert any("over 0.1,0.9,0.1" in note for note in result.metrics["notes"])
    # The bare background scores 9.5 dB.
    assert result.metrics["test"]["averaged"]["psnr"] > 20
    photograph, mask = run.store.get(0)
    assert mask.min() == 1.0
    assert np.allclose(photograph[0, 0], [0.1, 0.9, 0.1], atol=1e-4)
    assert np.allclose(photograph[SIZE // 2, SIZE // 2], COLOR, atol=3e-3)


def test_pictures_show_the_background_and_exr_files_do_not(ball):
    _, run = ball
    stem = run.folder / "renders" / "test" / "r_0"
    shown = cv2.imread(f"{stem}.render.png")[..., ::-1] / 255
    photograph = cv2.imread(f"{stem}.photograph.png")[..., ::-1] / 255
    assert np.abs(shown[:3, :3] - [0.1, 0.9, 0.1]).max() < 0.1
    assert np.abs(photograph[0, 0] - [0.1, 0.9, 0.1]).max() < 0.01
    linear, *_ = read_exr(stem.with_suffix(".exr"))
    assert np.abs(linear[:3, :3]).max() < 0.1
    assert run.own_display(0).backdrop == pytest.approx((0.1, 0.9, 0.1))


@pytest.fixture
def twin(ball, tmp_path):
    """Return a copy of the run's renders, a function that judges it, and the run's scores."""
    result, run = ball
    shutil.copytree(run.folder / "renders", tmp_path / "twin")

    def judged():
        found = check_renders(find_renders(tmp_path / "twin", run.scene), run.store)
        return judge_renders(found, Judge(run.scene, run.store, run.params, run.cfg))

    return tmp_path / "twin", judged, result.metrics["test"]


def test_renders_of_others_are_judged_over_the_same_background(twin):
    folder, judged, scores = twin
    for kind, suffix, limit in (("pictures", ".png", 0.1), ("radiance", ".exr", 0.01)):
        found = judged()
        fitted = found["exposure_fitted"]
        assert fitted["psnr"] == pytest.approx(scores["exposure_fitted"]["psnr"], abs=limit), kind
        for path in folder.rglob(f"*{suffix}"):
            path.unlink()
        if kind == "radiance":
            mean = found["as_rendered"]["psnr"]
            assert mean == pytest.approx(scores["averaged"]["psnr"], abs=limit)


def test_a_fitted_exposure_changes_the_object_and_not_the_background(twin):
    folder, judged, scores = twin
    # The background is darkened as well, which no exposure restores.
    for path in folder.rglob("*.render.png"):
        cv2.imwrite(str(path), np.rint(0.7 * cv2.imread(str(path)).astype(float)))
    found = judged()
    background_db = -10 * np.log10(0.75 * np.mean((0.3 * np.array([0.1, 0.9, 0.1])) ** 2))
    assert found["as_rendered"]["psnr"] < found["exposure_fitted"]["psnr"] < background_db + 1
    assert found["exposure_fitted"]["psnr"] < scores["exposure_fitted"]["psnr"] - 3


def test_two_backgrounds_are_refused(ball, tmp_path):
    _, run = ball
    cfg = with_fields(run.cfg, {"render.background": (1.0,) * 3})
    with pytest.raises(UserError, match=r"there are two backgrounds: render.background"):
        fit(run.scene.root, tmp_path / "run", cfg)


def test_radiance_over_a_background_needs_an_opacity(twin):
    folder, judged, _ = twin
    for path in folder.rglob("*.png"):
        path.unlink()
    path = next(folder.rglob("*.exr"))
    write_exr(path, read_exr(path)[0])
    with pytest.raises(UserError, match="no channel A"):
        judged()
