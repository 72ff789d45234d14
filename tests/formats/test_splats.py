"""Splats for other programs: read by their readers, or decoded here from published layouts."""

import gzip
import io
import itertools
import json
import struct
import tracemalloc
import zipfile
from dataclasses import replace
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pygltflib
import pytest
from PIL import Image
from plyfile import PlyData, PlyElement
from scipy.spatial.transform import Rotation
from splats import random_splats

from p2gs_jax.errors import UserError
from p2gs_jax.formats import gsply_files, ply
from p2gs_jax.formats.gltf import EXTENSION, write_gltf
from p2gs_jax.formats.packed import morton_order, pack, unpack
from p2gs_jax.formats.ply import field_names, read_ply, write_ply, write_radiance
from p2gs_jax.formats.splats import read_splats
from p2gs_jax.formats.usd import CAMERAS, SPLATS, write_usd
from p2gs_jax.render.harmonics import evaluate
from p2gs_jax.scene.rigid import pose_of
from p2gs_jax.types import Camera, Gaussians, Vibration

FLIP = np.array([1.0, -1.0, -1.0])


def covariances(xyzw, scales):
    R = Rotation.from_quat(np.asarray(xyzw, float)).as_matrix()
    return np.einsum("nij,nj,nkj->nik", R, np.asarray(scales, float) ** 2, R)


def ours(g):
    """Return covariances and opacities of Gaussians in COLMAP's axes."""
    xyzw = np.roll(np.asarray(g.quats, float), -1, axis=1)
    opacities = 1 / (1 + np.exp(-np.asarray(g.opacity_logits, float)))
    return covariances(xyzw, np.exp(np.asarray(g.log_scales, float))), opacities


def assert_same_colors(sh, g, atol=2e-5):
    """Compare colours in one direction; `sh` is in axes turned by FLIP."""
    direction = np.array([0.48, -0.6, 0.64])
    seen = evaluate(jnp.asarray(sh), tuple(np.tile(direction * FLIP, (len(sh), 1)).T))
    expected = evaluate(g.sh, tuple(np.tile(direction, (len(sh), 1)).T))
    np.testing.assert_allclose(seen, expected, atol=atol)


def gltf_columns(path):
    """Return what pygltflib reads: the document, its only primitive, and its attributes."""
    document: Any = pygltflib.GLTF2().load(str(path))
    blob, columns = document.binary_blob(), {}
    primitive = document.meshes[0].primitives[0]
    for name, index in vars(primitive.attributes).items():
        if index is None:
            continue
        accessor = document.accessors[index]
        view = document.bufferViews[accessor.bufferView]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor.type]
        assert accessor.componentType == pygltflib.FLOAT
        flat = np.frombuffer(blob, "<f4", accessor.count * width, view.byteOffset)
        columns[name] = flat.reshape(-1, width)
    return document, primitive, columns


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_gltf_is_read_by_pygltflib(tmp_path, degree):
    g = random_splats(degree=degree)
    write_gltf(tmp_path / "a.glb", g)
    document, primitive, found = gltf_columns(tmp_path / "a.glb")
    assert document.extensionsUsed == [EXTENSION]
    assert primitive.mode == pygltflib.POINTS
    assert primitive.extensions[EXTENSION]["kernel"] == "ellipse"
    np.testing.assert_allclose(found["POSITION"], np.asarray(g.means) * FLIP)
    accessor = document.accessors[primitive.attributes.POSITION]
    np.testing.assert_array_equal(accessor.min, found["POSITION"].min(0))
    np.testing.assert_array_equal(accessor.max, found["POSITION"].max(0))
    cov, opacities = ours(g)
    turned = covariances(found[f"{EXTENSION}:ROTATION"], found[f"{EXTENSION}:SCALE"])
    np.testing.assert_allclose(turned, cov * np.outer(FLIP, FLIP), rtol=1e-4, atol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(found[f"{EXTENSION}:ROTATION"], axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(found[f"{EXTENSION}:OPACITY"][:, 0], opacities, rtol=1e-5)
    assert len([n for n in found if "SH_DEGREE" in n]) == (degree + 1) ** 2
    orders = ((d, k) for d in range(degree + 1) for k in range(2 * d + 1))
    ordered = [f"{EXTENSION}:SH_DEGREE_{d}_COEF_{k}" for d, k in orders]
    assert_same_colors(np.stack([found[n] for n in ordered], 1), g)


def test_usd_is_read_by_pxr(tmp_path):
    modules = ("Gf", "Usd", "UsdGeom", "UsdVol")
    Gf, Usd, UsdGeom, UsdVol = (pytest.importorskip(f"pxr.{name}") for name in modules)
    g = random_splats(degree=2)
    turn = Rotation.from_euler("yxz", [20, -10, 5], degrees=True).as_matrix()
    pose = pose_of(turn, (0.3, -0.2, 0.5))
    K = np.array([[300.0, 0, 170.0], [0, 330.0, 118.0], [0, 0, 1]])
    write_usd(tmp_path / "a.usdc", g, {"left/1.jpg": Camera(pose, K, 320, 240)})

    stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
    assert UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.y
    field = UsdVol.ParticleField3DGaussianSplat.Get(stage, SPLATS)
    assert field
    read = {a.GetName(): a.Get() for a in field.GetPrim().GetAttributes()}
    np.testing.assert_allclose(read["positions"], np.asarray(g.means) * FLIP)
    xyzw = [[*q.GetImaginary(), q.GetReal()] for q in read["orientations"]]
    cov, opacities = ours(g)
    turned = covariances(xyzw, read["scales"])
    np.testing.assert_allclose(turned, cov * np.outer(FLIP, FLIP), rtol=1e-4, atol=1e-3)
    np.testing.assert_allclose(read["opacities"], opacities, rtol=1e-5)
    assert read["radiance:sphericalHarmonicsDegree"] == 2
    sh = np.array(read["radiance:sphericalHarmonicsCoefficients"]).reshape(50, 9, 3)
    assert_same_colors(sh, g)

    prim = UsdGeom.Camera.Get(stage, f"{CAMERAS}/view_0000")
    assert prim.GetPrim().GetMetadata("comment") == "left/1.jpg"
    frustum = prim.GetCamera(Usd.TimeCode.Default()).frustum
    matrix = frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()
    for point in np.random.default_rng(0).uniform([-1, -1, 3], [1, 1, 6], (20, 3)):
        local = pose[:3, :3] @ point + pose[:3, 3]
        expected = (K @ local)[:2] / local[2]
        ndc = matrix.Transform(Gf.Vec3d(*(point * FLIP)))
        seen = [(ndc[0] + 1) / 2 * 320, (1 - ndc[1]) / 2 * 240]
        np.testing.assert_allclose(seen, expected, atol=1e-3)


@pytest.fixture
def with_gsply():
    pytest.importorskip("gsply", reason="the extra `spz` is not installed")


def mild(degree):
    """Return Gaussians within the ranges that SPZ can hold."""
    g = random_splats(degree=degree)
    sh = jnp.clip(0.3 * g.sh, -0.9, 0.9)
    return replace(g, means=3 * g.means, log_scales=g.log_scales - 2, sh=sh)


def test_spz_follows_its_specification(tmp_path, with_gsply):
    """Version 3: 16 bytes of header, then positions, alphas, colours, scales, rotations, SH; axes
    right, up, back."""
    g = mild(1)
    gsply_files.write_spz(tmp_path / "a.spz", g)
    data = gzip.decompress((tmp_path / "a.spz").read_bytes())
    magic, version, count, degree, bits, flags, _ = struct.unpack_from("<IIIBBBB", data)
    assert (magic, version, count, degree, flags) == (0x5053474E, 3, 50, 1, 0)
    places = 16 + np.cumsum([0, 9 * count, count, 3 * count, 3 * count, 4 * count, 9 * count])
    parts = [np.frombuffer(data[a:b], np.uint8) for a, b in itertools.pairwise(places)]
    assert places[-1] == len(data)
    raw = parts[0].reshape(count, 3, 3).astype(np.int32)
    fixed = raw[..., 0] | raw[..., 1] << 8 | raw[..., 2] << 16
    fixed -= (fixed >= 1 << 23) * (1 << 24)
    np.testing.assert_allclose(fixed / 2**bits, np.asarray(g.means) * FLIP, atol=2.0**-bits)
    np.testing.assert_allclose(parts[1] / 255, ours(g)[1], atol=0.51 / 255)
    scales = parts[3].reshape(count, 3) / 16.0 - 10
    np.testing.assert_allclose(scales, g.log_scales, atol=0.51 / 16)
    rest = (parts[5].reshape(count, 3, 3) - 128.0) / 128
    assert_same_colors(np.concatenate([g.sh[:, :1], rest.astype(np.float32)], 1), g, atol=0.02)


def test_spz_never_clips_positions():
    for farthest in (0.4, 2047.0, 1e6):
        bits = gsply_files.fractional_bits(np.array([[0.0, -farthest, 1e-3]]))
        assert farthest * 2**bits <= 2**23 - 1 < farthest * 2 ** (bits + 1) or bits == 24
    with pytest.raises(UserError, match="1e\\+07"):
        gsply_files.fractional_bits(np.array([[1e7, 0.0, 0.0]]))


def test_without_gsply_the_error_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "gsply", None)
    for write in (gsply_files.write_spz, gsply_files.write_compressed_ply):
        with pytest.raises(UserError, match=r"pip install 'p2gs-jax\[spz\]'"):
            write(tmp_path / "a", mild(0))


@pytest.mark.parametrize("read", [gsply_files.read_spz, gsply_files.read_compressed_ply])
@pytest.mark.parametrize("content", [b"hello, this is not a splat", b"x" * 33, None])
def test_wrong_files_and_missing_ones_are_refused(tmp_path, with_gsply, read, content):
    path = tmp_path / "some.file"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(UserError, match=r"some\.file"):
        read(path)


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_files_of_gsply_are_read_back(tmp_path, with_gsply, degree):
    g = mild(degree)
    ways = (
        (gsply_files.write_compressed_ply, gsply_files.read_compressed_ply),
        (gsply_files.write_spz, gsply_files.read_spz),
    )
    for number, (write, read) in enumerate(ways):
        write(tmp_path / str(number), g)
        found = read(tmp_path / str(number))
        by_x = [np.argsort(np.asarray(splats.means[:, 0])) for splats in (found, g)]
        order = by_x[0][np.argsort(by_x[1])]
        np.testing.assert_allclose(found.means[order], g.means, atol=0.02)
        np.testing.assert_allclose(found.log_scales[order], g.log_scales, atol=0.05)
        np.testing.assert_allclose(ours(found)[1][order], ours(g)[1], atol=0.003)
        np.testing.assert_allclose(found.sh[order], g.sh, atol=0.04)
        turned = ours(found)[0][order] - ours(g)[0]
        assert np.abs(turned).max() < 0.05 * np.exp(2 * np.asarray(g.log_scales)).max()


def sog(path, quats, *, version=2, bands=2):
    """Write three Gaussians as developer.playcanvas.com describes SOG, texel by texel."""
    omitted = np.abs(quats).argmax(1)
    signs = np.sign(quats[range(3), omitted])
    others = [np.delete(q * s, k) for q, s, k in zip(quats, signs, omitted, strict=True)]
    turned = np.rint(255 * (np.array(others) / np.sqrt(2) + 0.5))
    textures = {
        # 16 bits of a position: 0, 65535 and 256.
        "means_l": [[0, 0, 0], [255, 255, 255], [0, 0, 0]],
        "means_u": [[0, 0, 0], [255, 255, 255], [1, 1, 1]],
        "scales": [[0, 1, 2], [3, 4, 5], [6, 7, 255]],
        "quats": np.column_stack([turned, 252 + omitted]),
        "sh0": [[10, 20, 30, 0], [40, 50, 60, 128], [70, 80, 90, 255]],
        "shN_labels": [[0, 0, 0], [65, 0, 0], [2, 1, 0]],
        # 259 entries of a palette, 64 in a row, each with eight coefficients.
        "shN_centroids": np.arange(5 * 512 * 3).reshape(5, 512, 3) % 256,
    }
    table, files = (np.arange(256) / 64 - 2).tolist(), {}
    for name, values in textures.items():
        texels = np.array(values, np.uint8)
        image = Image.fromarray(texels if texels.ndim == 3 else texels[None])
        image.save(buffer := io.BytesIO(), "webp", lossless=True, exact=True)
        files[f"{name}.webp"] = buffer.getvalue()
    means = {"mins": [-1, -2, 0], "maxs": [1, 2, 3], "files": ["means_l.webp", "means_u.webp"]}
    meta = {"version": version, "count": 3, "means": means, "quats": {"files": ["quats.webp"]}}
    meta |= {part: {"codebook": table, "files": [f"{part}.webp"]} for part in ("scales", "sh0")}
    names = ["shN_centroids.webp", "shN_labels.webp"]
    meta["shN"] = {"count": 259, "bands": bands, "codebook": table, "files": names}
    with zipfile.ZipFile(path, "w") as file:
        for name, data in {**files, "meta.json": json.dumps(meta).encode()}.items():
            file.writestr(name, data)


def test_sog_is_read_as_its_specification_says(tmp_path):
    quats = np.array([[0.9, 0.1, -0.3, 0.3], [0.1, -0.2, 0.1, -0.97], [-0.3, 0.9, 0.2, 0.2]])
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    sog(tmp_path / "a.sog", quats)
    g = read_splats(tmp_path / "a.sog")
    logs = np.array(
        [[-1, -2, 0], [1, 2, 3], np.array([-1, -2, 0]) + 256 / 65535 * np.array([2, 4, 3])]
    )
    np.testing.assert_allclose(g.means, np.sign(logs) * np.expm1(np.abs(logs)), rtol=1e-5)
    np.testing.assert_allclose(g.log_scales[2], np.array([6, 7, 255]) / 64 - 2)
    same = np.abs((np.asarray(g.quats) * quats).sum(1))
    np.testing.assert_allclose(same, 1, atol=1e-4)
    assert np.isfinite(g.opacity_logits).all()
    np.testing.assert_allclose(ours(g)[1], [0, 128 / 255, 1], atol=0.003)
    np.testing.assert_allclose(g.sh[1, 0], np.array([40, 50, 60]) / 64 - 2)
    # The labels are 0, 65 and 2 + 256: the entries 0, 1 and 2 of the rows 0, 1 and 4.
    first = 3 * np.array([0, 512 + 8, 4 * 512 + 2 * 8])[:, None]
    entries = (np.arange(8 * 3) + first) % 256
    np.testing.assert_allclose(g.sh[:, 1:], entries.reshape(3, 8, 3) / 64 - 2)
    sog(tmp_path / "old.sog", quats, version=1)
    whole = (tmp_path / "a.sog").read_bytes()
    (tmp_path / "torn.sog").write_bytes(whole[:900])
    with zipfile.ZipFile(tmp_path / "bad.sog", "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("meta.json", "{}" * 99)
    packed = bytearray((tmp_path / "bad.sog").read_bytes())
    packed[39:42] = b"\xff" * 3  # where the compressed data begin
    (tmp_path / "bad.sog").write_bytes(packed)
    # Bytes of the last entry of the directory: its flags (1: encrypted), and its method.
    entry = whole.rindex(b"PK\1\2")
    for name, at, value in (("locked", 8, 1), ("method", 10, 99)):
        changed = bytearray(whole)
        changed[entry + at] = value
        (tmp_path / f"{name}.sog").write_bytes(changed)
    for name, why in (
        ("old", "its version is 1"),
        ("torn", "zip"),
        ("bad", "decompressing"),
        ("locked", "encrypted"),
        ("method", "not supported"),
    ):
        with pytest.raises(UserError, match=why):
            read_splats(tmp_path / f"{name}.sog")


def test_the_end_of_a_name_decides_how_splats_are_read(tmp_path, with_gsply):
    g = mild(1)
    write_ply(tmp_path / "a.PLY", g, [])
    gsply_files.write_compressed_ply(tmp_path / "b.compressed.ply", g)
    gsply_files.write_spz(tmp_path / "c.spz", g)
    for name in ("a.PLY", "b.compressed.ply", "c.spz"):
        found = np.sort(np.asarray(read_splats(tmp_path / name).means[:, 0]))
        np.testing.assert_allclose(found, np.sort(np.asarray(g.means[:, 0])), atol=0.02)


def test_packing_keeps_the_ellipsoids():
    g = random_splats(1000, degree=1)
    g = replace(g, means=g.means * np.array([10, 1, 300]), log_scales=2 * g.log_scales - 3)
    order = morton_order(np.asarray(g.means))
    before, after = ours(g)[0][order], ours(unpack(pack(g)))[0]
    size = np.trace(before, axis1=1, axis2=2)
    assert (np.abs(after - before).max((1, 2)) / size).max() < 0.02
    g = replace(random_splats(3), quats=jnp.zeros((3, 4)))
    np.testing.assert_allclose(np.asarray(unpack(pack(g)).quats), [[1, 0, 0, 0]] * 3, atol=1e-3)
    assert unpack(pack(random_splats(0))).capacity == 0


def population(n, degree=1, *, moves=False):
    rng = np.random.default_rng(n)

    def draw(*shape):
        return rng.normal(size=(n, *shape)).astype(np.float32)

    vibration = Vibration(draw(3), draw(), draw()) if moves else None
    shapes = ((3,), (4,), (3,), (), ((degree + 1) ** 2, 3))
    return Gaussians(*(draw(*shape) for shape in shapes), vibration=vibration)


@pytest.mark.parametrize("moves", [False, True])
@pytest.mark.parametrize("count", [0, 1, 9, 10, 11, 25])
def test_every_row_is_read_back_with_any_size_of_chunks(tmp_path, monkeypatch, count, moves):
    monkeypatch.setattr(ply, "CHUNK", 10)
    g = population(count, degree=2, moves=moves)
    write_ply(tmp_path / "a.ply", g, ["line"])
    for a, b in zip(jax.tree.leaves(read_ply(tmp_path / "a.ply")), jax.tree.leaves(g), strict=True):
        assert np.asarray(a).tobytes() == b.tobytes()


def test_fields_and_bytes_are_those_of_plyfile(tmp_path, monkeypatch):
    monkeypatch.setattr(ply, "CHUNK", 4)
    g = population(23, degree=3)
    names = field_names(16)
    assert names[:9] == ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    assert names[9:54] == [f"f_rest_{i}" for i in range(45)]
    rest = [f"scale_{i}" for i in range(3)], [f"rot_{i}" for i in range(4)]
    assert names[54:] == ["opacity", *rest[0], *rest[1]]
    comments = ["p2gs-jax: linear HDR radiance", "p2gs-jax: radiance activation exp"]
    write_radiance(tmp_path / "ours.ply", g, activation="exp")
    # Red's coefficients come first, all of them.
    bands = g.sh[:, 1:].transpose(0, 2, 1).reshape(23, -1)
    zero, logits = np.zeros((23, 3), np.float32), g.opacity_logits[:, None]
    columns = [g.means, zero, g.sh[:, 0], bands, logits, g.log_scales, g.quats]
    table = np.ascontiguousarray(np.concatenate(columns, 1))
    rows = table.view([(name, "<f4") for name in names]).reshape(-1)
    element = PlyElement.describe(rows, "vertex")
    PlyData([element], byte_order="<", comments=comments).write(str(tmp_path / "theirs.ply"))
    assert (tmp_path / "ours.ply").read_bytes() == (tmp_path / "theirs.ply").read_bytes()
    moving = population(23, moves=True)
    write_radiance(tmp_path / "moving.ply", moving, activation="exp")
    chex.assert_trees_all_equal(read_ply(tmp_path / "moving.ply"), moving)


def test_memory_does_not_grow_with_the_file(tmp_path, monkeypatch):
    """Beside the population: a few chunks while writing, a copy of its largest part while reading.

    tracemalloc counts NumPy's arrays; those of the device are not among them.
    """
    monkeypatch.setattr(ply, "CHUNK", 1000)
    g = population(40_000, degree=3)
    size = sum(leaf.nbytes for leaf in jax.tree.leaves(g))
    tracemalloc.start()
    try:
        write_ply(tmp_path / "a.ply", g, [])
        assert tracemalloc.get_traced_memory()[1] < size / 8
        tracemalloc.reset_peak()
        read_ply(tmp_path / "a.ply")
        assert tracemalloc.get_traced_memory()[1] < 1.2 * size
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("kept", [0.3, 0.99, None])
def test_cut_files_and_other_files_are_refused(tmp_path, kept):
    path = tmp_path / "a.ply"
    write_ply(path, population(100), [])
    content = path.read_bytes()
    path.write_bytes(b"hello" if kept is None else content[: int(kept * len(content))])
    with pytest.raises(UserError, match=r"a\.ply is not a valid PLY of Gaussians"):
        read_ply(path)
