"""Renders of other programs: the view that a file shows, and the pixels that count."""

from dataclasses import replace
from typing import Any, cast

import cv2
import jax.numpy as jnp
import numpy as np
import pytest
from tiny_scene import noise_scene

from p2gs_jax import FitConfig, Params, Photometry, UserError
from p2gs_jax.evaluation.against import check_renders, judge_renders
from p2gs_jax.evaluation.evaluate import Judge
from p2gs_jax.evaluation.renders_of_others import find_renders
from p2gs_jax.scene.pixels.store import ImageStore

SIZE = (40, 34)


def made_scene(folder, held_out, masked=False):
    """Return a training view and some held out, of noise, and their photographs."""
    folder.mkdir()
    scene = noise_scene(folder, ("train.png",), held_out, masked)
    return scene, ImageStore(scene.views, FitConfig().data)


def judge(scene, store):
    photometry = Photometry(jnp.zeros(1), jnp.zeros(1), "log")
    # Renders are judged without any Gaussians.
    return Judge(scene, store, Params(cast(Any, None), photometry), FitConfig())


def photograph(scene, name):
    image = cv2.imread(str(scene.root / name))
    assert image is not None
    return image


def test_numbered_renders_are_in_the_order_of_names(tmp_path):
    scene, store = made_scene(tmp_path / "scene", ("r_2.png", "r_10.png", "r_30.png"))
    (tmp_path / "other").mkdir()
    for k, name in enumerate(("r_10.png", "r_2.png", "r_30.png")):
        cv2.imwrite(str(tmp_path / "other" / f"{k:05d}.PNG"), photograph(scene, name))
    (tmp_path / "linked").mkdir()
    (tmp_path / "linked" / "here").symlink_to(tmp_path / "other")
    for folder in ("other", "linked"):
        found = check_renders(find_renders(tmp_path / folder, scene), store)
        assert judge_renders(found, judge(scene, store))["as_rendered"]["psnr"] > 100


def test_views_that_masks_hide_are_not_judged(tmp_path):
    scene, _ = made_scene(tmp_path / "scene", ("a.png", "b.png"))
    (tmp_path / "other").mkdir()
    for name in ("a.png", "b.png"):
        cv2.imwrite(str(tmp_path / "other" / name), photograph(scene, name))
    found, mask = find_renders(tmp_path / "other", scene), tmp_path / "mask.png"
    cv2.imwrite(str(mask), np.zeros(SIZE[::-1], np.uint8))
    a, b = (replace(scene.views[row], mask_path=mask) for row in sorted(found.files))
    part, none = (
        ImageStore((scene.views[0], a, last), FitConfig().data) for last in (scene.views[2], b)
    )
    scores = judge_renders(check_renders(found, part), judge(scene, part))
    assert [*scores["as_rendered"]["per_view"]] == ["b.png"]
    with pytest.raises(UserError, match="masks hide every held-out view of which"):
        check_renders(found, none)


def test_masked_pixels_do_not_count(tmp_path):
    scene, store = made_scene(tmp_path / "scene", ("a.png",), masked=True)
    image = photograph(scene, "a.png")
    image[:, :20] = 255 - image[:, :20]
    (tmp_path / "other").mkdir()
    cv2.imwrite(str(tmp_path / "other" / "a.png"), image)
    found = find_renders(tmp_path / "other", scene)
    assert judge_renders(found, judge(scene, store))["as_rendered"]["psnr"] > 100
    whole, everywhere = made_scene(tmp_path / "whole", ("a.png",))
    found = find_renders(tmp_path / "other", whole)
    assert judge_renders(found, judge(whole, everywhere))["as_rendered"]["psnr"] < 20


def test_16_bits_and_grey_are_display_values_too(tmp_path):
    scene, store = made_scene(tmp_path / "scene", ("a.png", "b.png"))
    folder = tmp_path / "other"
    folder.mkdir()
    cv2.imwrite(str(folder / "a.png"), photograph(scene, "a.png").astype(np.uint16) * 257)
    cv2.imwrite(str(folder / "b.png"), np.full(SIZE[::-1], 51, np.uint8))
    found = find_renders(folder, scene)
    scores = judge_renders(found, judge(scene, store))["as_rendered"]["per_view"]
    assert scores["a.png"]["psnr"] > 100
    grey, linear, _ = found.read(2, SIZE)
    assert not linear
    np.testing.assert_allclose(grey, 0.2, atol=1e-6)


def test_a_scene_without_held_out_views_cannot_be_compared(tmp_path):
    scene, _ = made_scene(tmp_path / "scene", ())
    with pytest.raises(UserError, match="has no held-out views"):
        find_renders(tmp_path, scene)
