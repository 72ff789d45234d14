"""Views without a pixel that counts have no score, photographs that tell no exposure are named."""

import dataclasses
import json

import cv2
import numpy as np
import pytest

from p2gs_jax.config import LossConfig
from p2gs_jax.evaluate.evaluate import evaluate
from p2gs_jax.evaluate.untold import Untold, untold_notes
from p2gs_jax.render.capacity import make_renderer
from p2gs_jax.run.read import load_run
from p2gs_jax.scene.images import ImageStore

SIZE = (20, 30)
EVERYTHING = np.ones(SIZE, np.float32)


def grey(value):
    return np.full((*SIZE, 3), value, np.float32)


@pytest.mark.parametrize(
    ("photograph", "known"),
    [(grey(0.0), False), (grey(1.0), False), (grey(0.01), False), (grey(0.5), True)],
)
def test_black_and_saturated_photographs_tell_no_exposure(photograph, known):
    found = Untold()
    assert found.add("a.png", photograph, EVERYTHING, LossConfig())
    assert found.to_dict() == ({} if known else {"exposures_unknown": ["a.png"]})


def test_one_channel_and_a_few_pixels_are_enough_and_what_is_masked_tells_nothing():
    for change, mask, known in (
        ((slice(0, 1), slice(0, 1), 1), EVERYTHING, True),
        (
            (slice(0, 5), slice(0, 5), slice(None)),
            np.where(np.arange(30) < 6, 0, EVERYTHING),
            False,
        ),
    ):
        photograph, found = grey(0.0), Untold()
        photograph[change] = 0.4
        found.add("a.png", photograph, np.float32(mask), LossConfig())
        assert (not found.exposures) == known


def test_a_hidden_view_cannot_be_judged_and_says_nothing_of_its_exposure():
    found = Untold()
    assert not found.add("a.png", grey(0.0), 0 * EVERYTHING, LossConfig())
    assert found.to_dict() == {"hidden": ["a.png"]}


def test_the_notes_name_the_first_views():
    names = [f"{k}.png" for k in range(10)]
    hidden, unknown = untold_notes({"hidden": ["a.png"], "exposures_unknown": names})
    assert "1 view(s) are hidden" in hidden
    assert "(a.png)" in hidden
    assert "10 photograph(s)" in unknown
    assert "7.png, ...)" in unknown
    assert untold_notes({"train": {}}) == []


def test_hidden_views_are_left_out_of_the_scores(tmp_path, finished_run):
    run = load_run(finished_run)
    before = json.loads((finished_run / "metrics.json").read_text())
    trained = list(before["train"]["per_view"])
    held_out = list(before["test"]["averaged"]["per_view"])

    def changed(view):
        mask, black = tmp_path / f"mask_{view.name}", tmp_path / view.name
        hidden = view.name in (trained[0], held_out[0])
        cv2.imwrite(str(mask), np.full((view.height, view.width), 0 if hidden else 255, np.uint8))
        cv2.imwrite(str(black), np.zeros((view.height, view.width, 3), np.uint8))
        dark = view.name == trained[1]
        image = black if dark else view.image_path
        return dataclasses.replace(view, mask_path=mask, image_path=image)

    scene = dataclasses.replace(run.scene, views=tuple(map(changed, run.scene.views)))
    shown = []
    now = evaluate(
        run.params,
        np.asarray(run.alive),
        scene,
        ImageStore(scene.views, run.cfg.data),
        make_renderer(run.cfg.render, run.owner),
        run.cfg,
        on_view=shown.append,
    )
    assert sorted(now["hidden"]) == sorted([trained[0], held_out[0]])
    assert now["exposures_unknown"] == [trained[1]]
    assert list(now["train"]["per_view"]) == trained[1:]
    for name in trained[2:]:
        assert now["train"]["per_view"][name] == pytest.approx(before["train"]["per_view"][name])
    for protocol in ("averaged", "exposure_fitted"):
        assert list(now["test"][protocol].get("per_view", {})) == held_out[1:]
    assert len(shown) == len(scene.views), "what is not scored is written all the same"
