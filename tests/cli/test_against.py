"""`eval --against`: renders of other programs in every layout, and errors for broken ones."""

import json
import shutil

import cv2
import numpy as np
import pytest

from p2gs_jax.core.atomic import write_json
from p2gs_jax.formats.exr import write_exr
from p2gs_jax.run.read import load_run


@pytest.fixture(scope="module")
def run_copy(finished_run, tmp_path_factory):
    return shutil.copytree(finished_run, tmp_path_factory.mktemp("against") / "castle")


@pytest.fixture(scope="module")
def held_out(run_copy):
    """Return the held-out photographs by name, in OpenCV's 8-bit BGR."""
    scene = load_run(run_copy).scene
    views = [scene.views[row] for row in scene.test_indices]
    return {view.name: cv2.imread(str(view.image_path)) for view in views}


def write(path, image):
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


@pytest.fixture
def judged(succeeded, run_copy):
    """Return a function from folders of renders to the scores of each and the printed text."""

    def judge(*folders, options=()):
        text = succeeded("eval", run_copy, "--against", *folders, *options)
        found = json.loads((run_copy / "against.json").read_text())["programs"]
        return [*found.values()], text

    return judge


def test_replaced_photographs_are_not_judged(run_copy, refused):
    before = (run_copy / "metrics.json").read_text()
    config = json.loads((run_copy / "config.json").read_text())
    write_json(run_copy / "config.json", config | {"photographs": "of another time"})
    assert "was begun with other photographs" in refused("eval", run_copy)
    assert (run_copy / "metrics.json").read_text() == before
    write_json(run_copy / "config.json", config)


def test_renders_of_the_run_itself_have_its_scores(run_copy, judged, tmp_path):
    twin = shutil.copytree(run_copy / "renders", tmp_path / "twin")
    before = json.loads((run_copy / "metrics.json").read_text()) | {"districts": {"blocks": [1]}}
    (run_copy / "metrics.json").write_text(json.dumps(before))
    (found,), text = judged(twin)
    # `--against` keeps the scores of the fit and unknown keys.
    after = json.loads((run_copy / "metrics.json").read_text())
    assert before.keys() == after.keys()
    assert {k: after[k] for k in ("split", "counts", "districts")} == {
        k: before[k] for k in ("split", "counts", "districts")
    }
    of_run = found["run"]["exposure_fitted"]
    assert found["layout"] == "pictures by name"
    # Held-out views are written under the exposure fitted to them, in 8 bits.
    for protocol in ("as_rendered", "exposure_fitted"):
        assert found[protocol]["psnr"] == pytest.approx(of_run["psnr"], abs=0.05)
        assert found[protocol]["ssim"] == pytest.approx(of_run["ssim"], abs=2e-3)
    saved = json.loads((run_copy / "metrics.json").read_text())["test"]["exposure_fitted"]
    assert of_run["psnr"] == saved["psnr"]
    assert "castle (this run)" in text
    # EXR renders are developed like the radiance of the run.
    for picture in twin.glob("*.png"):
        picture.unlink()
    (found,), _ = judged(twin)
    assert found["exposure_fitted"]["psnr"] == pytest.approx(of_run["psnr"], abs=0.01)
    averaged = found["run"]["averaged"]["psnr"]
    assert found["as_rendered"]["psnr"] == pytest.approx(averaged, abs=0.01)


def test_an_exposure_per_view_corrects_darker_renders(held_out, judged, tmp_path):
    for k, name in enumerate(sorted(held_out)):
        write(tmp_path / f"a/{k:05d}.png", held_out[name])
        write(tmp_path / f"b/{k:05d}.png", held_out[name] // 2)
    (a, b), _ = judged(tmp_path / "a", tmp_path / "b")
    assert a["layout"] == "numbered pictures"
    assert a["as_rendered"]["psnr"] > 100
    assert b["exposure_fitted"]["psnr"] > b["as_rendered"]["psnr"] + 10


def test_missing_views_are_named_and_left_out_of_both_scores(run_copy, held_out, judged, tmp_path):
    kept, lost = sorted(held_out)
    training = load_run(run_copy).scene.training_views[0].name
    for name in (kept, training, "logo.png"):
        write(tmp_path / "part" / name, held_out[kept])
    (found,), text = judged(tmp_path / "part")
    assert found["missing"] == [lost]
    assert found["views"] == 1
    assert list(found["run"]["averaged"]["per_view"]) == [kept]
    assert f"lacks 1 of 2 held-out views ({lost})" in " ".join(text.split())


def test_scores_against_a_reference_are_also_scale_aligned(held_out, judged, tmp_path):
    for name, image in held_out.items():
        write(tmp_path / "reference" / name, image)
        write(tmp_path / "other" / name, image // 2)
    options = ("--reference", tmp_path / "reference")
    (found,), text = judged(tmp_path / "other", options=options)
    reference = found["reference"]
    assert reference["scale_aligned"]["psnr"] > reference["as_rendered"]["psnr"] + 5
    # The run has one row (scale aligned), the program two (also as rendered).
    assert text.split("beside other programs")[1].count("reference") == 3


def infinite(path, image):
    path.unlink()
    write_exr(path.with_suffix(".exr"), np.full(image.shape, np.inf, np.float32))


def numbered(path, image):
    for k, name in enumerate(sorted(path.parent.iterdir())):
        name.rename(path.parent / f"{k:05d}.png")
    write(path.parent / "00002.png", image)


def renamed(path, image):
    for name in [*path.parent.iterdir()]:
        name.rename(path.parent / f"x{name.name}")


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda path, image: write(path, image[:-2]), "112x98"),
        (lambda path, image: path.write_bytes(path.read_bytes()[:40]), "cannot be read"),
        (
            lambda path, image: write(path, np.dstack([image, image // 2])[..., :4]),
            "transparent in",
        ),
        (infinite, "infinite"),
        (numbered, "3 numbered renders, but the run has 2"),
        (renamed, "no render of a held-out view"),
        (lambda path, image: shutil.rmtree(path.parent), "not a folder"),
    ],
)
def test_broken_renders_are_refused_before_any_evaluation(
    run_copy, held_out, refused, tmp_path, spoil, words
):
    folder, image = tmp_path / "other", next(iter(held_out.values()))
    for name in held_out:
        write(folder / name, image)
    spoil(folder / max(held_out), image)
    before = (run_copy / "metrics.json").stat().st_mtime_ns
    text = refused("eval", run_copy, "--against", folder)
    assert words in " ".join(text.split())
    assert "To fix it" in text
    assert (run_copy / "metrics.json").stat().st_mtime_ns == before
