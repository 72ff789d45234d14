"""`eval --against`: renders of other programs in every layout, and what is wrong with them."""

import json
import shutil

import cv2
import numpy as np
import pytest

from p2gs_jax.formats.exr import write_exr
from p2gs_jax.run.read import load_run


@pytest.fixture(scope="module")
def own_run(finished_run, tmp_path_factory):
    return shutil.copytree(finished_run, tmp_path_factory.mktemp("against") / "castle")


@pytest.fixture(scope="module")
def held_out(own_run):
    """Return the held-out photographs by name, 8 bits, as OpenCV has them."""
    scene = load_run(own_run).scene
    views = [scene.views[row] for row in scene.test_indices]
    return {view.name: cv2.imread(str(view.image_path)) for view in views}


def write(path, image):
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


@pytest.fixture
def judged(succeeded, own_run):
    """Return a function from folders of renders to what is found of each, and what was printed."""

    def judge(*folders, options=()):
        text = succeeded("eval", own_run, "--against", *folders, *options)
        found = json.loads((own_run / "against.json").read_text())["programs"]
        return [*found.values()], text

    return judge


def test_what_the_run_rendered_itself_scores_as_the_run(own_run, judged, tmp_path):
    twin = shutil.copytree(own_run / "renders", tmp_path / "twin")
    before = json.loads((own_run / "metrics.json").read_text()) | {"districts": {"blocks": [1]}}
    (own_run / "metrics.json").write_text(json.dumps(before))
    (found,), text = judged(twin)
    # What a fit says of itself stays, whatever it is.
    after = json.loads((own_run / "metrics.json").read_text())
    assert before.keys() == after.keys()
    assert {k: after[k] for k in ("split", "counts", "districts")} == {
        k: before[k] for k in ("split", "counts", "districts")
    }
    own = found["run"]["exposure_fitted"]
    assert found["layout"] == "pictures by name"
    # Held-out views are written under the exposure fitted to them, in 8 bits.
    for protocol in ("as_rendered", "exposure_fitted"):
        assert found[protocol]["psnr"] == pytest.approx(own["psnr"], abs=0.05)
        assert found[protocol]["ssim"] == pytest.approx(own["ssim"], abs=2e-3)
    saved = json.loads((own_run / "metrics.json").read_text())["test"]["exposure_fitted"]
    assert own["psnr"] == saved["psnr"]
    assert "castle (this run)" in text
    # Radiance is developed as the run develops its own.
    for picture in twin.glob("*.png"):
        picture.unlink()
    (found,), _ = judged(twin)
    assert found["exposure_fitted"]["psnr"] == pytest.approx(own["psnr"], abs=0.01)
    averaged = found["run"]["averaged"]["psnr"]
    assert found["as_rendered"]["psnr"] == pytest.approx(averaged, abs=0.01)


def test_an_exposure_a_view_undoes_what_is_a_matter_of_exposure(held_out, judged, tmp_path):
    for k, name in enumerate(sorted(held_out)):
        write(tmp_path / f"a/{k:05d}.png", held_out[name])
        write(tmp_path / f"b/{k:05d}.png", held_out[name] // 2)
    (a, b), _ = judged(tmp_path / "a", tmp_path / "b")
    assert a["layout"] == "numbered pictures"
    assert a["as_rendered"]["psnr"] > 100
    assert b["exposure_fitted"]["psnr"] > b["as_rendered"]["psnr"] + 10


def test_views_that_are_missing_are_said_and_left_out_of_both(own_run, held_out, judged, tmp_path):
    kept, lost = sorted(held_out)
    training = load_run(own_run).scene.training_views[0].name
    for name in (kept, training, "logo.png"):
        write(tmp_path / "part" / name, held_out[kept])
    (found,), text = judged(tmp_path / "part")
    assert found["missing"] == [lost]
    assert found["views"] == 1
    assert list(found["run"]["averaged"]["per_view"]) == [kept]
    said = " ".join(text.split())
    assert f"lacks 1 of 2 held-out views ({lost})" in said


def test_a_common_exposure_is_judged_too(held_out, judged, tmp_path):
    for name, image in held_out.items():
        write(tmp_path / "reference" / name, image)
        write(tmp_path / "other" / name, image // 2)
    options = ("--reference", tmp_path / "reference")
    (found,), text = judged(tmp_path / "other", options=options)
    reference = found["reference"]
    assert reference["scale_aligned"]["psnr"] > reference["as_rendered"]["psnr"] + 5
    # Of the run scale aligned, of the program also as rendered.
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
    ("spoil", "said"),
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
def test_what_is_wrong_is_said_before_anything_is_judged(
    own_run, held_out, refused, tmp_path, spoil, said
):
    folder, image = tmp_path / "other", next(iter(held_out.values()))
    for name in held_out:
        write(folder / name, image)
    spoil(folder / max(held_out), image)
    before = (own_run / "metrics.json").stat().st_mtime_ns
    text = refused("eval", own_run, "--against", folder)
    assert said in " ".join(text.split())
    assert "To fix it" in text
    assert (own_run / "metrics.json").stat().st_mtime_ns == before
