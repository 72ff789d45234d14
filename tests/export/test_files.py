"""What is written can be read back, by us and by others, or is not there at all."""

import os

import jax.numpy as jnp
import numpy as np
import OpenEXR
import pytest
from plyfile import PlyData

from p2gs_jax.errors import UserError
from p2gs_jax.export.atomic import append_jsonl, atomic_write, read_jsonl, write_json
from p2gs_jax.export.checkpoint import CheckpointStore
from p2gs_jax.export.exr import read_exr, write_exr
from p2gs_jax.export.photometry_json import read_photometry, write_photometry
from p2gs_jax.export.ply import display_sh, field_names, read_ply, write_radiance, write_splats
from p2gs_jax.types import Camera, Gaussians


def gaussians(n=50, degree=3, seed=0):
    rng = np.random.default_rng(seed)
    shapes = [(n, 3), (n, 4), (n, 3), (n,), (n, (degree + 1) ** 2, 3)]
    return Gaussians(*(jnp.asarray(rng.normal(size=s), jnp.float32) for s in shapes))


def test_atomic_write_leaves_the_old_file_on_failure(tmp_path):
    path = tmp_path / "a.json"
    write_json(path, {"x": 1})

    def fail():
        with atomic_write(path) as temporary:
            temporary.write_text("half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert '"x": 1' in path.read_text()
    assert os.listdir(tmp_path) == ["a.json"]


def test_json_has_no_nan(tmp_path):
    write_json(tmp_path / "a.json", {"a": float("nan"), "b": jnp.float32(2), "c": np.arange(2)})
    assert "NaN" not in (tmp_path / "a.json").read_text()


def test_torn_last_line_is_left_out(tmp_path):
    path = tmp_path / "log.jsonl"
    append_jsonl(path, {"step": 1})
    append_jsonl(path, {"step": 2})
    with path.open("a") as file:
        file.write('{"step": 3, "lo')
    assert [r["step"] for r in read_jsonl(path)] == [1, 2]
    assert read_jsonl(tmp_path / "none.jsonl") == []


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_radiance_ply_round_trip_is_exact(tmp_path, degree):
    g = gaussians(degree=degree)
    alive = np.arange(50) % 3 > 0
    assert write_radiance(tmp_path / "r.ply", g, alive, activation="exp") == alive.sum()
    back = read_ply(tmp_path / "r.ply")
    for name in ("means", "quats", "log_scales", "opacity_logits", "sh"):
        np.testing.assert_array_equal(getattr(back, name), np.asarray(getattr(g, name))[alive])


def test_ply_field_order_is_the_reference_one(tmp_path):
    write_radiance(tmp_path / "r.ply", gaussians(), np.ones(50, bool), activation="exp")
    ply = PlyData.read(str(tmp_path / "r.ply"))
    names = [p.name for p in ply["vertex"].properties]
    assert names == field_names(16)
    assert names[:9] == ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    assert names[9:54] == [f"f_rest_{i}" for i in range(45)]
    assert names[54:] == [
        "opacity",
        *(f"scale_{i}" for i in range(3)),
        *(f"rot_{i}" for i in range(4)),
    ]
    # Red's coefficients come first, all of them.
    assert ply["vertex"]["f_rest_0"][0] == gaussians().sh[0, 1, 0]
    assert ply["vertex"]["f_rest_15"][0] == gaussians().sh[0, 1, 1]
    assert any("linear" in c for c in ply.comments)


def tone(x):
    return np.clip(x, 0, 1) ** (1 / 2.2)


def test_display_colours_are_exact_for_degree_0_and_close_for_3(tmp_path):
    g = gaussians(degree=0)
    shown = display_sh(np.asarray(g.sh), tone, "exp")
    expected = tone(np.exp(0.28209479 * np.asarray(g.sh[:, 0])))
    np.testing.assert_allclose(0.28209479 * shown[:, 0] + 0.5, expected, atol=1e-5)
    mild = np.asarray(gaussians(degree=3).sh) * 0.1
    mild[:, 0] -= 3
    shown = display_sh(mild, tone, "exp")
    d = np.array([0.36, 0.48, 0.8])
    from p2gs_jax.render.spherical_harmonics import basis

    table = np.array([float(b[0]) for b in basis(jnp.asarray(d[None], jnp.float32), 3)])
    expected = tone(np.exp(np.einsum("k,nkc->nc", table, mild)))
    found = np.einsum("k,nkc->nc", table, shown) + 0.5
    assert np.abs(found - expected).max() < 0.03
    write_splats(tmp_path / "s.ply", g, np.ones(50, bool), tone=tone, activation="exp")
    assert "display" in PlyData.read(str(tmp_path / "s.ply")).comments[0]


def test_not_a_ply(tmp_path):
    (tmp_path / "x.ply").write_text("hello")
    with pytest.raises(UserError, match=r"x\.ply"):
        read_ply(tmp_path / "x.ply")


def test_exr_holds_radiance_exposure_and_camera(tmp_path):
    rng = np.random.default_rng(0)
    linear = np.exp2(rng.uniform(-10, 6, (7, 9, 3))).astype(np.float32)
    cam = Camera(jnp.eye(4).at[0, 3].set(2.5), jnp.eye(3), 9, 7)
    depth = np.full((7, 9), 4.0, np.float32)
    alpha = np.full((7, 9), 0.5, np.float32)
    write_exr(
        tmp_path / "a.exr", linear, depth=depth, alpha=alpha, exposure=2.0, gamma=2.2, camera=cam
    )
    back, header = read_exr(tmp_path / "a.exr")
    np.testing.assert_allclose(back, linear, rtol=1e-3)
    assert header["p2gsExposure"] == 2.0
    assert header["p2gsExposureEV"] == 1.0
    assert header["worldToCamera"][0, 3] == 2.5
    assert header["chromaticities"][0] == pytest.approx(0.64)
    with OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True) as file:
        np.testing.assert_allclose(file.channels()["Z"].pixels, 8.0)


def test_exr_never_overflows_half(tmp_path):
    linear = np.full((4, 4, 3), 1e6, np.float32)
    write_exr(tmp_path / "a.exr", linear)
    np.testing.assert_array_equal(read_exr(tmp_path / "a.exr")[0], linear)
    write_exr(tmp_path / "b.exr", linear / 100, half=False)
    np.testing.assert_array_equal(read_exr(tmp_path / "b.exr")[0], linear / 100)


def test_broken_exr(tmp_path):
    (tmp_path / "x.exr").write_bytes(b"no")
    with pytest.raises(UserError, match=r"x\.exr"):
        read_exr(tmp_path / "x.exr")


def test_photometry_round_trip(tmp_path):
    view = {
        "image": "a.png",
        "camera": "0",
        "exposure": None,
        "exposure_ev": None,
        "gamma": None,
        "exif_ev": 1.5,
        "split": "test",
        "exposure_fitted": 1.2,
    }
    path = tmp_path / "photometry.json"
    write_photometry(path, model="m", curve={}, gauge="g", mean={}, views=[view])
    assert read_photometry(path)["views"][0] == view
    path.write_text("{}")
    with pytest.raises(UserError, match="incomplete"):
        read_photometry(path)


def test_checkpoints_are_exact_and_the_last_two_are_kept(tmp_path):
    store = CheckpointStore(tmp_path / "c")
    assert store.latest_step() is None
    trees = {s: {"a": gaussians(seed=s), "n": jnp.int32(s)} for s in (1, 2, 3)}
    for s, tree in trees.items():
        store.save(s, tree, {"capacity": 50 + s})
    store = CheckpointStore(tmp_path / "c")
    assert store.latest_step() == 3
    tree, meta = store.restore_latest(lambda meta: trees[3])
    assert meta == {"capacity": 53}
    np.testing.assert_array_equal(tree["a"].sh, trees[3]["a"].sh)
    assert int(tree["n"]) == 3
    assert store.restore(2, trees[2])["n"] == 2
    with pytest.raises(UserError):
        store.restore(1, trees[1])


def test_a_broken_newest_checkpoint_falls_back(tmp_path):
    store = CheckpointStore(tmp_path / "c")
    for s in (1, 2):
        store.save(s, {"x": jnp.full(1000, float(s))}, {"s": s})
    for path in (tmp_path / "c" / "2").rglob("*"):
        if path.is_file():
            path.write_bytes(b"")
    told = []
    found = CheckpointStore(tmp_path / "c").restore_latest(
        lambda m: {"x": jnp.zeros(1000)}, told.append
    )
    assert found is not None
    assert float(found[0]["x"][0]) == 1.0
    assert told
