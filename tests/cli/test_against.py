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
    folder = tmp_path_factory.mktemp("against") / "castle"
    shutil.copytree(finished_run, folder)
    return folder


@pytest.fixture(scope="module")
def held_out(own_run):
    """Return the held-out photographs by name, 8 bits, as OpenCV has them."""
    scene = load_run(own_run).scene
    views = [scene.views[row] for row in scene.test_indices]
    assert len(views) == 2
    return {view.name: cv2.imread(str(view.image_path)) for view in views}


def write(path, image):
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


def judged(run_command, run, folder, *options):
    code, text = run_command("eval", run, "--against", folder, *options)
    assert code == 0, text
    found = json.loads((run / "against.json").read_text())["programs"]
    return next(iter(found.values())), text


def test_what_the_run_rendered_itself_scores_as_the_run(own_run, run_command, tmp_path):
    shutil.copytree(own_run / "renders", tmp_path / "twin")
    found, text = judged(run_command, own_run, tmp_path / "twin")
    own = found["run"]["exposure_fitted"]
    assert found["layout"] == "pictures by name"
    # Held-out views are written under the exposure fitted to them, in 8 bits.
    for protocol in ("as_rendered", "exposure_fitted"):
        assert found[protocol]["psnr"] == pytest.approx(own["psnr"], abs=0.05)
        assert found[protocol]["ssim"] == pytest.approx(own["ssim"], abs=2e-3)
    assert (
        own["psnr"]
        == json.loads((own_run / "metrics.json").read_text())["test"]["exposure_fitted"]["psnr"]
    )
    assert "castle (this run)" in text
    assert "twin" in text
    # Radiance is developed as the run develops its own.
    for picture in (tmp_path / "twin").glob("*.png"):
        picture.unlink()
    found, _ = judged(run_command, own_run, tmp_path / "twin")
    assert found["exposure_fitted"]["psnr"] == pytest.approx(own["psnr"], abs=0.01)
    averaged = found["run"]["averaged"]["psnr"]
    assert found["as_rendered"]["psnr"] == pytest.approx(averaged, abs=0.01)


def test_folders_of_3dgs_and_gsplat_are_read(own_run, held_out, run_command, tmp_path):
    pictures = [held_out[name] for name in sorted(held_out)]
    for k, image in enumerate(pictures):
        write(tmp_path / f"a/test/ours_7000/renders/{k:05d}.png", 255 - image)
        write(tmp_path / f"a/test/ours_30000/renders/{k:05d}.png", image)
        write(tmp_path / f"b/renders/val_step6999_{k:04d}.png", np.hstack([image, 255 - image]))
        write(tmp_path / f"b/renders/val_step29999_{k:04d}.png", np.hstack([image, image // 2]))
    code, text = run_command("eval", own_run, "--against", tmp_path / "a", tmp_path / "b")
    assert code == 0, text
    found = json.loads((own_run / "against.json").read_text())["programs"]
    assert [found[n]["layout"] for n in "ab"] == ["3DGS, ours_30000", "gsplat, step 29999"]
    assert found["a"]["as_rendered"]["psnr"] > 100
    half = np.mean([np.mean(((i - i // 2) / 255.0) ** 2) for i in pictures[:1]])
    first = found["b"]["as_rendered"]["per_view"][min(held_out)]["psnr"]
    assert first == pytest.approx(-10 * np.log10(half), abs=1e-3)
    # One scalar a view undoes most of what is a matter of exposure.
    assert found["b"]["exposure_fitted"]["psnr"] > found["b"]["as_rendered"]["psnr"] + 10


def test_views_that_are_missing_are_said_and_left_out_of_both(
    own_run, held_out, run_command, tmp_path
):
    kept, lost = sorted(held_out)
    write(tmp_path / "part" / kept, held_out[kept])
    training = load_run(own_run).scene.training_views[0].name
    write(tmp_path / "part" / training, held_out[kept])
    write(tmp_path / "part" / "logo.png", held_out[kept])
    found, text = judged(run_command, own_run, tmp_path / "part")
    assert found["missing"] == [lost]
    assert found["views"] == 1
    assert list(found["run"]["averaged"]["per_view"]) == [kept]
    said = " ".join(text.split())
    assert f"lacks 1 of 2 held-out views ({lost})" in said
    assert "1 files show training views and 1 no view" in said


def test_a_common_exposure_is_judged_too(own_run, held_out, run_command, tmp_path):
    for name, image in held_out.items():
        write(tmp_path / "reference" / name, image)
        write(tmp_path / "other" / name, image // 2)
    options = ("--reference", tmp_path / "reference")
    found, text = judged(run_command, own_run, tmp_path / "other", *options)
    reference = found["reference"]
    assert reference["scale_aligned"]["psnr"] > reference["as_rendered"]["psnr"] + 5
    # Of the run scale aligned, of the program also as rendered.
    assert text.split("beside other programs")[1].count("reference") == 3


def broken(kind, folder, held_out):
    image = next(iter(held_out.values()))
    for name in held_out:
        write(folder / name, image)
    path = folder / max(held_out)
    if kind == "size":
        write(path, image[:-2])
    elif kind == "broken":
        path.write_bytes(path.read_bytes()[:40])
    elif kind == "transparent":
        write(path, np.concatenate([image, image[..., :1] // 2], -1))
    elif kind == "infinite":
        path.unlink()
        write_exr(path.with_suffix(".exr"), np.full(image.shape, np.inf, np.float32))
    elif kind == "count":
        for k, name in enumerate(held_out):
            (folder / name).rename(folder / f"{k:05d}.png")
        write(folder / "00002.png", image)
    elif kind == "none":
        for name in held_out:
            (folder / name).rename(folder / f"x{name}")
    else:
        shutil.rmtree(folder)


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("size", "112x98"),
        ("broken", "cannot be read"),
        ("transparent", "transparent in places"),
        ("infinite", "infinite"),
        ("count", "3 numbered renders, the run holds 2"),
        ("none", "no render of a held-out view"),
        ("absent", "not a folder"),
    ],
)
def test_what_is_wrong_is_said_before_anything_is_judged(
    own_run, held_out, run_command, tmp_path, kind, said
):
    broken(kind, tmp_path / "other", held_out)
    before = (own_run / "metrics.json").stat().st_mtime_ns
    code, text = run_command("eval", own_run, "--against", tmp_path / "other")
    assert code == 2
    assert said in " ".join(text.split())
    assert "To fix it" in text
    assert (own_run / "metrics.json").stat().st_mtime_ns == before
