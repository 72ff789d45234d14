"""glTF, OpenUSD and compressed PLY, read by other people's readers."""

from typing import Any

import numpy as np
import pygltflib
import pytest
from plyfile import PlyData
from scipy.spatial.transform import Rotation
from splats import random_splats

from p2gs_jax.errors import UserError
from p2gs_jax.formats.compressed_ply import read_compressed_ply, write_compressed_ply
from p2gs_jax.formats.gltf import EXTENSION, write_gltf
from p2gs_jax.formats.usd import CAMERAS, SPLATS, NamedCamera, write_usd
from p2gs_jax.render.harmonics import C0, evaluate

FLIP = np.array([1.0, -1.0, -1.0])


def covariances(xyzw, scales):
    R = Rotation.from_quat(np.asarray(xyzw, float)).as_matrix()
    return np.einsum("nij,nj,nkj->nik", R, np.asarray(scales, float) ** 2, R)


def ours(g):
    """Return covariances and opacities of Gaussians in COLMAP's axes."""
    xyzw = np.roll(np.asarray(g.quats, float), -1, axis=1)
    opacities = 1 / (1 + np.exp(-np.asarray(g.opacity_logits, float)))
    return covariances(xyzw, np.exp(np.asarray(g.log_scales, float))), opacities


def harmonics(direction, degree):
    """Return real harmonics with the Condon-Shortley phase, as glTF's extension tabulates them."""
    x, y, z = direction
    table = [
        0.28209479177387814,
        -0.4886025119029199 * y,
        0.4886025119029199 * z,
        -0.4886025119029199 * x,
        1.0925484305920792 * x * y,
        -1.0925484305920792 * y * z,
        0.31539156525252005 * (2 * z * z - x * x - y * y),
        -1.0925484305920792 * x * z,
        0.5462742152960396 * (x * x - y * y),
        -0.5900435899266435 * y * (3 * x * x - y * y),
        2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4 * z * z - x * x - y * y),
        0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
        -0.4570457994644658 * x * (4 * z * z - x * x - y * y),
        1.445305721320277 * z * (x * x - y * y),
        -0.5900435899266435 * x * (x * x - 3 * y * y),
    ]
    return np.array(table[: (degree + 1) ** 2])


def assert_same_colors(sh, g):
    """Check coefficients of a world that is turned by FLIP, in a direction."""
    direction = np.array([0.48, -0.6, 0.64])
    degree = int(np.sqrt(sh.shape[1])) - 1
    seen = np.einsum("k,nkc->nc", harmonics(direction * FLIP, degree), sh)
    expected = evaluate(g.sh, tuple(np.tile(direction, (len(sh), 1)).T))
    np.testing.assert_allclose(seen, expected, atol=2e-5)


def gltf_columns(path):
    """Read the attributes of the one primitive by pygltflib."""
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
    assert write_gltf(tmp_path / "a.glb", g) == 50
    document, primitive, found = gltf_columns(tmp_path / "a.glb")
    assert document.extensionsUsed == [EXTENSION]
    assert primitive.mode == pygltflib.POINTS
    assert primitive.extensions[EXTENSION]["kernel"] == "ellipse"
    np.testing.assert_allclose(found["POSITION"], np.asarray(g.means) * FLIP)
    said = document.accessors[primitive.attributes.POSITION]
    np.testing.assert_array_equal(said.min, found["POSITION"].min(0))
    np.testing.assert_array_equal(said.max, found["POSITION"].max(0))
    cov, opacities = ours(g)
    turned = covariances(found[f"{EXTENSION}:ROTATION"], found[f"{EXTENSION}:SCALE"])
    np.testing.assert_allclose(turned, cov * np.outer(FLIP, FLIP), rtol=1e-4, atol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(found[f"{EXTENSION}:ROTATION"], axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(found[f"{EXTENSION}:OPACITY"][:, 0], opacities, rtol=1e-5)
    names = [n for n in found if "SH_DEGREE" in n]
    assert len(names) == (degree + 1) ** 2
    orders = ((d, k) for d in range(degree + 1) for k in range(2 * d + 1))
    ordered = [f"{EXTENSION}:SH_DEGREE_{d}_COEF_{k}" for d, k in orders]
    assert_same_colors(np.stack([found[n] for n in ordered], 1), g)


def test_usd_is_read_by_pxr(tmp_path):
    modules = ("Gf", "Usd", "UsdGeom", "UsdVol")
    Gf, Usd, UsdGeom, UsdVol = (pytest.importorskip(f"pxr.{name}") for name in modules)
    g = random_splats(degree=2)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("yxz", [20, -10, 5], degrees=True).as_matrix()
    pose[:3, 3] = 0.3, -0.2, 0.5
    K = np.array([[300.0, 0, 170.0], [0, 330.0, 118.0], [0, 0, 1]])
    camera = NamedCamera("left/1.jpg", pose, K, 320, 240)
    write_usd(tmp_path / "a.usdc", g, [camera])

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


def unpacked(codes, bits):
    """Return the fields of whole numbers, from the most significant one on, in [0, 1]."""
    out, shift = [], 32
    for b in bits:
        shift -= b
        out.append(((codes >> shift) & (2**b - 1)) / (2**b - 1))
    return np.stack(out, 1)


def test_compressed_ply_follows_its_published_layout(tmp_path):
    """https://blog.playcanvas.com/compressing-gaussian-splats: blocks of 256 with ranges."""
    g = random_splats(n=600)
    write_compressed_ply(tmp_path / "a.compressed.ply", g)
    data = PlyData.read(str(tmp_path / "a.compressed.ply"))
    chunk, vertex = data["chunk"].data, data["vertex"].data
    block = np.arange(len(vertex)) // 256
    assert len(chunk) == 3

    def scaled(name, kind):
        low, high = (
            np.stack([chunk[f"{end}_{kind}{axis}"][block] for axis in "xyz"], 1)
            for end in ("min", "max")
        )
        return low + unpacked(vertex[name], (11, 10, 11)) * (high - low)

    position = scaled("packed_position", "")
    match = np.argmin(((position[:, None] - np.asarray(g.means)) ** 2).sum(-1), 1)
    assert len(set(match)) == 600
    np.testing.assert_allclose(position, np.asarray(g.means)[match], atol=0.01)
    scales = scaled("packed_scale", "scale_")
    np.testing.assert_allclose(scales, np.asarray(g.log_scales)[match], atol=0.01)
    color = unpacked(vertex["packed_color"], (8, 8, 8, 8))
    _, opacities = ours(g)
    np.testing.assert_allclose(color[:, 3], opacities[match], atol=0.003)
    back = read_compressed_ply(tmp_path / "a.compressed.ply")
    np.testing.assert_allclose(back.means, position, atol=1e-5)
    np.testing.assert_allclose(
        C0 * np.asarray(back.sh[:, 0]), C0 * np.asarray(g.sh)[match, 0], atol=0.02
    )
    np.testing.assert_allclose(
        back.sh[:, 1:], np.clip(np.asarray(g.sh)[match, 1:], -4, 4), atol=0.1
    )


def test_wrong_files_are_refused(tmp_path):
    (tmp_path / "a.compressed.ply").write_bytes(b"no ply")
    with pytest.raises(UserError, match="no readable compressed PLY"):
        read_compressed_ply(tmp_path / "a.compressed.ply")
