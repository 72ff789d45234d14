"""Every protocol of an evaluation, LPIPS with weights, and views without information."""

import dataclasses
import json
import time

import cv2
import jax.numpy as jnp
import numpy as np
import pytest
from lpips_files import made_weights
from splats import random_splats, rendered
from tiny_scene import noise_scene

from p2gs_jax import Params, Photometry, UserError, evaluate, load_run
from p2gs_jax.cli.tables import print_metrics
from p2gs_jax.config import FitConfig, LossConfig
from p2gs_jax.core.numerics import srgb_encode
from p2gs_jax.core.threads import MOST_WORKERS, map_in_order
from p2gs_jax.evaluation.lpips import lpips
from p2gs_jax.evaluation.references import load_reference
from p2gs_jax.evaluation.scores import notes_on_missing, psnr, tells_exposure
from p2gs_jax.scene.pixels.store import ImageStore

HEIGHT, WIDTH = 34, 40


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Return two training views and one held out, of noise."""
    return noise_scene(tmp_path_factory.mktemp("noise"), ("0.png", "1.png"), ("2.png",))


def judged(scene, *, slope=0.0, **options):
    """Return the metrics of a grey fit, darker on one side; photographs are its references."""
    store = ImageStore(scene.views, FitConfig().data)

    def shaded(gaussians, alive, camera):
        flat = jnp.ones((camera.height, camera.width), jnp.float32)
        across = jnp.linspace(1 - slope, 1 + slope, camera.width)
        return rendered(0.2 * jnp.tile((flat * across)[..., None], 3), depth=flat)

    return evaluate(
        Params(random_splats(0, degree=0), Photometry(jnp.zeros(2), jnp.zeros(2), "log"), None),
        scene,
        store,
        FitConfig(),
        render=shaded,
        reference=lambda row: store.get(row, 1)[0],
        **options,
    ).metrics


def test_every_comparison_has_lpips_where_there_are_weights(scene, tmp_path, capsys):
    weights = made_weights("alex")
    metrics = judged(scene, lpips_weights=weights)
    parts = [
        (metrics["train"], 2),
        (metrics["train"]["averaged"], 2),
        (metrics["test"]["averaged"], 1),
        (metrics["test"]["exposure_fitted"], 1),
        (metrics["test"]["photometry_fitted"], 1),
    ]
    for part in metrics["reference"].values():
        parts += [(part, 3), (part["train"], 2), (part["test"], 1)]
    assert len(parts) == 11
    for part, views in parts:
        rows = [row["lpips"] for row in part["per_view"].values()]
        assert len(rows) == views
        assert min(rows) > 0
        assert part["lpips"] == pytest.approx(np.mean(rows))
    # Every exposure is 1 and every gamma sRGB's, except the held-out view's fitted exposure.
    store = ImageStore(scene.views, FitConfig().data)
    for row, part in ((0, metrics["train"]), (2, metrics["test"]["averaged"])):
        photograph, mask = store.get(row, 1)
        grey = np.full_like(photograph, 1.055 * 0.2 ** (1 / 2.4) - 0.055)
        expected = float(lpips(weights, grey, photograph, mask))
        assert part["per_view"][f"{row}.png"]["lpips"] == pytest.approx(expected, rel=1e-3)
    averaged, fitted = (metrics["test"][name]["lpips"] for name in ("averaged", "exposure_fitted"))
    assert fitted != pytest.approx(averaged, rel=1e-2)

    print_metrics(metrics)
    printed = capsys.readouterr().out
    assert f"{metrics['test']['averaged']['lpips']:.4f}" in printed
    assert "n/a" not in printed


def test_radiance_and_references_are_compared_in_a_second_pass(scene):
    store = ImageStore(scene.views, FitConfig().data)
    found = judged(scene, slope=0.5, radiance=lambda row: 0.01 + store.get(row, 1)[0])
    for part in (found["radiance"], found["reference"]["scale_aligned"]):
        assert len(part["per_view"]) == 3
        assert {"train", "test"} <= set(part)


def test_references_of_another_size_or_kind_are_refused_before_a_fit(tmp_path):
    (tmp_path / "scene").mkdir()
    scene = noise_scene(tmp_path / "scene", ("[0].png", "1.png"), ("2.png",))
    picture = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    # A JPEG may stand for a PNG, also if its name holds characters of patterns.
    cv2.imwrite(str(tmp_path / "[0].jpg"), picture)
    reference = load_reference(tmp_path, scene, FitConfig())
    assert reference(1) is None
    np.testing.assert_allclose(reference(0), 90 / 255, atol=0.01)
    (tmp_path / "1.exr").touch()
    with pytest.raises(UserError, match=r"--reference: .*1\.exr is neither PNG"):
        load_reference(tmp_path, scene, FitConfig())
    cv2.imwrite(str(tmp_path / "1.png"), picture[:20])
    with pytest.raises(UserError, match=r"--reference: .*1\.png has 40x20 pixels, but .* 40x34"):
        load_reference(tmp_path, scene, FitConfig())


SIZE = (20, 30)
EVERYTHING = np.ones(SIZE, np.float32)


def grey(value):
    return np.full((*SIZE, 3), value, np.float32)


LOSS = LossConfig()


def test_black_and_saturated_photographs_tell_no_exposure_but_a_few_pixels_are_enough():
    for value, known in ((0.0, False), (1.0, False), (0.01, False), (0.5, True)):
        assert tells_exposure(grey(value), EVERYTHING, LOSS) is known
    few, corner = (slice(0, 1), slice(0, 1), 1), (slice(0, 5), slice(0, 5), slice(None))
    hidden = np.where(np.arange(30) < 6, 0, EVERYTHING)
    for change, mask, known in ((few, EVERYTHING, True), (corner, hidden, False)):
        photograph = grey(0.0)
        photograph[change] = 0.4
        assert tells_exposure(photograph, np.float32(mask), LOSS) is known
    assert tells_exposure(grey(0.0), 0 * EVERYTHING, LOSS) is None


def test_the_notes_name_the_first_views():
    names = [f"{k}.png" for k in range(10)]
    hidden, unknown = notes_on_missing({"hidden": ["a.png"], "exposures_unknown": names})
    assert hidden == "Masks hide every pixel of a.png, so no score is known there."
    assert "meaningless for 0.png, 1.png, 2.png, 3.png, 4.png and 5 more: all pixels" in unknown
    assert notes_on_missing({"train": {}}) == []


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
        image = black if view.name == trained[1] else view.image_path
        return dataclasses.replace(view, mask_path=mask, image_path=image)

    scene = dataclasses.replace(run.scene, views=tuple(map(changed, run.scene.views)))
    shown = []
    now = evaluate(
        run.params, scene, ImageStore(scene.views, run.cfg.data), run.cfg, on_view=shown.append
    ).metrics
    assert sorted(now["hidden"]) == sorted([trained[0], held_out[0]])
    assert now["exposures_unknown"] == [trained[1]]
    assert list(now["train"]["per_view"]) == trained[1:]
    for name in trained[2:]:
        assert now["train"]["per_view"][name] == pytest.approx(before["train"]["per_view"][name])
    for protocol in ("averaged", "exposure_fitted"):
        assert list(now["test"][protocol].get("per_view", {})) == held_out[1:]
    assert len(shown) == len(scene.views), "views without scores are written too"


KEY = 0.2


@pytest.mark.parametrize("metered", [True, False])
def test_held_out_views_are_scored_under_the_metering_of_training_views(tmp_path, metered):
    """The camera held the log average at KEY, or exposures are random."""
    levels = np.exp2(np.random.default_rng(0).normal(-2, 1, 24))
    drawn = np.exp2(np.random.default_rng(3).normal(0, 1, 24))
    scene = noise_scene(tmp_path, [f"{k:02d}.png" for k in range(24)], ("99.png",))
    shown = dict(zip(range(25), [*levels, 0.4], strict=True))

    def moved(row, view):
        pose = view.viewmat.copy()
        pose[0, 3] = shown[row]
        return dataclasses.replace(view, viewmat=pose)

    scene = dataclasses.replace(scene, views=tuple(map(moved, shown, scene.views)))

    def render(gaussians, alive, camera):
        flat = jnp.ones((camera.height, camera.width), jnp.float32)
        return rendered(camera.viewmat[0, 3] * jnp.tile(flat[..., None], 3), depth=flat)

    logs = jnp.log(jnp.asarray(KEY / levels if metered else drawn))
    params = Params(random_splats(0, degree=0), Photometry(logs, jnp.zeros(24), "log"), None)
    store = ImageStore(scene.views, FitConfig().data)
    test = evaluate(params, scene, store, FitConfig(), render=render).metrics["test"]
    if metered:
        (row,) = test["metered"]["per_view"].values()
        assert row["exposure"] == pytest.approx(KEY / 0.4, rel=1e-4)
        photograph, mask = store.get(24, 1)
        expected = psnr(srgb_encode(np.full_like(photograph, KEY)), photograph, mask)
        assert row["psnr"] == pytest.approx(float(expected), abs=0.01)
    else:
        assert "metered" not in test


def test_results_keep_their_order_and_an_error_ends_the_rest():
    def slow_if_even(k):
        time.sleep(0.01 * (k % 2 == 0))
        return k * k

    assert list(map_in_order(slow_if_even, range(20))) == [k * k for k in range(20)]
    assert list(map_in_order(slow_if_even, [])) == []
    seen = []

    def failing(k):
        seen.append(k)
        if k == 3:
            raise ValueError("no such view")
        return k

    with pytest.raises(ValueError, match="no such view"):
        list(map_in_order(failing, range(1000)))
    assert len(seen) < 1000


def test_the_first_item_is_computed_alone_and_few_results_wait():
    started = []
    results = map_in_order(started.append, range(100))
    assert started == []
    next(results)
    assert started == [0]
    next(results)
    time.sleep(0.05)
    assert len(started) <= 2 * MOST_WORKERS + 2
    results.close()
