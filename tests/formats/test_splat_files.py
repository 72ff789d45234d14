""".splat and .spz: read back by us, and decoded here from their published layouts."""

import gzip
import struct

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from splats import random_splats

from p2gs_jax.errors import UserError
from p2gs_jax.formats.splat import read_splat, write_splat
from p2gs_jax.formats.spz import fractional_bits, read_spz, write_spz
from p2gs_jax.render.harmonics import C0, evaluate

FLIP = np.array([1.0, -1.0, -1.0])


def covariances(quats, log_scales):
    """Return the matrices of Gaussians, from wxyz."""
    R = Rotation.from_quat(np.roll(np.asarray(quats, float), -1, axis=1)).as_matrix()
    return np.einsum("nij,nj,nkj->nik", R, np.exp(2 * np.asarray(log_scales, float)), R)


def opacities(g):
    return 1 / (1 + np.exp(-np.asarray(g.opacity_logits, float)))


def by_x(records, x):
    """Return the order that sorts the records as the Gaussians."""
    return np.argsort(records)[np.argsort(np.argsort(x))]


def test_splat_holds_what_viewers_expect(tmp_path):
    """32 bytes each; decoded as viser's example does (bytes to [-1, 1] by * 2 / 255 - 1)."""
    g = random_splats(degree=0)
    path = tmp_path / "a.splat"
    assert write_splat(path, g) == 50
    raw = np.frombuffer(path.read_bytes(), np.uint8).reshape(50, 32)
    means, scales = raw[:, :12].copy().view("<f4"), raw[:, 12:24].copy().view("<f4")
    conspicuous = scales.prod(1) * raw[:, 27]
    assert (np.diff(conspicuous) <= 0.02 * conspicuous[:-1]).all(), "the largest come first"
    raw, means, scales = (
        a[by_x(means[:, 0], np.asarray(g.means[:, 0]))] for a in (raw, means, scales)
    )
    np.testing.assert_array_equal(means, g.means)
    np.testing.assert_allclose(scales, np.exp(g.log_scales), rtol=1e-6)
    colors = np.clip(0.5 + C0 * np.asarray(g.sh[:, 0]), 0, 1)
    np.testing.assert_allclose(raw[:, 24:27] / 255, colors, atol=0.5 / 255 + 1e-6)
    np.testing.assert_allclose(raw[:, 27] / 255, opacities(g), atol=0.5 / 255 + 1e-6)
    found = covariances(raw[:, 28:32] / 255.0 * 2 - 1, np.log(scales))
    largest = np.exp(2 * np.asarray(g.log_scales)).max(1)[:, None, None]
    assert np.abs(found - covariances(g.quats, g.log_scales)).max() < 0.05 * largest.max()
    assert (np.abs(found - covariances(g.quats, g.log_scales)) < 0.05 * largest).all()


def test_splat_read_back(tmp_path):
    g = random_splats(degree=0)
    write_splat(tmp_path / "a.splat", g)
    back = read_splat(tmp_path / "a.splat")
    order = by_x(np.asarray(back.means[:, 0]), np.asarray(g.means[:, 0]))
    np.testing.assert_array_equal(back.means[order], g.means)
    np.testing.assert_allclose(back.log_scales[order], g.log_scales, atol=1e-5)
    np.testing.assert_allclose(opacities(back)[order], opacities(g), atol=0.5 / 255 + 1e-6)
    colors = np.clip(0.5 + C0 * np.asarray(g.sh), 0, 1)
    np.testing.assert_allclose(0.5 + C0 * back.sh[order], colors, atol=0.5 / 255 + 1e-6)
    # A second trip changes nothing more.
    write_splat(tmp_path / "b.splat", back)
    assert (
        np.abs(np.asarray(read_splat(tmp_path / "b.splat").sh) - np.asarray(back.sh)).max() < 1e-5
    )


def test_splat_refuses_view_dependence_and_other_files(tmp_path):
    with pytest.raises(ValueError, match="degree 0"):
        write_splat(tmp_path / "a.splat", random_splats(degree=1))
    (tmp_path / "b.splat").write_bytes(b"x" * 33)
    with pytest.raises(UserError, match=r"b\.splat is no \.splat: 33 bytes"):
        read_splat(tmp_path / "b.splat")
    with pytest.raises(UserError, match=r"none\.splat"):
        read_splat(tmp_path / "none.splat")


@pytest.fixture
def with_gsply():
    pytest.importorskip("gsply", reason="the extra `spz` is not installed")


def mild(degree):
    """Return Gaussians within the ranges that SPZ can hold."""
    g = random_splats(degree=degree)
    return type(g)(
        3 * g.means, g.quats, g.log_scales - 2, g.opacity_logits, jnp.clip(0.3 * g.sh, -0.9, 0.9)
    )


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_spz_read_back(tmp_path, with_gsply, degree):
    g = mild(degree)
    assert write_spz(tmp_path / "a.spz", g) == 50
    back = read_spz(tmp_path / "a.spz")
    step = 2.0 ** -fractional_bits(np.asarray(g.means))
    np.testing.assert_allclose(back.means, g.means, atol=0.51 * step)
    np.testing.assert_allclose(back.log_scales, g.log_scales, atol=0.51 / 16)
    np.testing.assert_allclose(opacities(back), opacities(g), atol=0.51 / 255)
    np.testing.assert_allclose(back.sh[:, 0], g.sh[:, 0], atol=0.51 / (0.15 * 255))
    np.testing.assert_allclose(back.sh[:, 1:], g.sh[:, 1:], atol=0.51 / 128)
    turned = covariances(back.quats, g.log_scales) - covariances(g.quats, g.log_scales)
    assert np.abs(turned).max() < 0.01 * np.exp(2 * np.asarray(g.log_scales)).max()


def test_spz_follows_its_specification(tmp_path, with_gsply):
    """Version 3: 16 bytes of header, then positions, alphas, colours, scales, rotations, SH; axes
    right, up, back."""
    g = mild(1)
    write_spz(tmp_path / "a.spz", g)
    data = gzip.decompress((tmp_path / "a.spz").read_bytes())
    magic, version, count, degree, bits, flags, _ = struct.unpack_from("<IIIBBBB", data)
    assert (magic, version, count, degree, flags) == (0x5053474E, 3, 50, 1, 0)
    at = 16
    raw = np.frombuffer(data, np.uint8, 9 * count, at).reshape(count, 3, 3).astype(np.int32)
    fixed = raw[..., 0] | raw[..., 1] << 8 | raw[..., 2] << 16
    fixed -= (fixed >= 1 << 23) * (1 << 24)
    np.testing.assert_allclose(fixed / 2**bits, np.asarray(g.means) * FLIP, atol=2.0**-bits)
    at += 9 * count
    np.testing.assert_allclose(
        np.frombuffer(data, np.uint8, count, at) / 255, opacities(g), atol=0.51 / 255
    )
    at += count + 3 * count
    scales = np.frombuffer(data, np.uint8, 3 * count, at).reshape(count, 3) / 16.0 - 10
    np.testing.assert_allclose(scales, g.log_scales, atol=0.51 / 16)
    at += 3 * count + 4 * count
    rest = (np.frombuffer(data, np.uint8, 9 * count, at).reshape(count, 3, 3) - 128.0) / 128
    assert at + 9 * count == len(data)
    # The same colour in the same direction, each in its own axes.
    sh = jnp.concatenate([g.sh[:, :1], jnp.asarray(rest, jnp.float32)], 1)
    d = np.array([0.36, 0.48, 0.8])
    ours = evaluate(g.sh, tuple(jnp.full(count, v) for v in d))
    theirs = evaluate(sh, tuple(jnp.full(count, v) for v in d * FLIP))
    np.testing.assert_allclose(ours, theirs, atol=0.02)


def test_spz_never_clips_positions():
    assert fractional_bits(np.array([[0.0, 0.0, 0.0]])) == 24
    for farthest in (0.4, 1.0, 2047.0, 3000.0, 1e6):
        bits = fractional_bits(np.array([[0.0, -farthest, 1e-3]]))
        assert farthest * 2**bits <= 2**23 - 1 < farthest * 2 ** (bits + 1) or bits == 24
    with pytest.raises(UserError, match="1e\\+07"):
        fractional_bits(np.array([[1e7, 0.0, 0.0]]))


def test_spz_without_its_package_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "gsply", None)
    with pytest.raises(UserError, match=r"pip install 'p2gs-jax\[spz\]'"):
        write_spz(tmp_path / "a.spz", mild(0))


def test_no_spz(tmp_path, with_gsply):
    (tmp_path / "a.spz").write_bytes(b"hello, this is no splat")
    with pytest.raises(UserError, match=r"a\.spz"):
        read_spz(tmp_path / "a.spz")
