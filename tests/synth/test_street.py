"""The street's files agree with each other, with the sensor model and with COLMAP's reader."""

import csv
import json
from pathlib import Path

import numpy as np
import OpenEXR
import pycolmap
import pytest
from PIL import Image
from scipy.ndimage import map_coordinates

from p2gs_jax import UserError, write_street
from p2gs_jax.config import DataConfig
from p2gs_jax.core.numerics import srgb_decode, srgb_encode
from p2gs_jax.scene.colmap import load_colmap
from p2gs_jax.synth.furnish import STREET_M, build_town
from p2gs_jax.synth.rig import MOUNTS, camera_viewmat, carla_rotation, drive, intrinsics
from p2gs_jax.synth.sensor import draw_shots, photograph, read_true_exposures, write_true_exposures
from p2gs_jax.synth.settings import Sensor, image_height
from p2gs_jax.synth.town import Material

# The options of the fixture `noisy_street`.
SIZE = {"frames": 5, "width": 192, "height": 128, "points": 6000}
SIZE |= {"supersample": 1, "seed": 3}


def read_png(path: Path) -> np.ndarray:
    return np.asarray(Image.open(path))


NAMES = [f"{camera}/{f:06d}.png" for camera in sorted(MOUNTS) for f in range(SIZE["frames"])]


def truth(street, name):
    """Return linear radiance, and camera z in metres, which is infinite in the sky."""
    path = (street / "truth" / "linear" / name).with_suffix(".exr")
    with OpenEXR.File(str(path), separate_channels=True) as file:
        pixels = {k: np.array(c.pixels, np.float32) for k, c in file.channels().items()}
    return np.stack([pixels[c] for c in "RGB"], axis=-1), pixels["Z"]


@pytest.fixture(scope="module")
def street(noisy_street):
    return noisy_street


@pytest.fixture(scope="module")
def scene(street):
    return load_colmap(street, street / "sparse" / "0", DataConfig())


def test_renders_are_deterministic_in_the_seed(street, tmp_path):
    # Photographs are not compared: their ISO values are drawn for the whole drive at once.
    again = write_street(tmp_path / "again", **SIZE | {"frames": 1})
    folders = ("reference", "truth/linear", "truth/sky_masks")
    files = [p for folder in folders for p in (again / folder).rglob("*.*")]
    assert len(files) == 9
    for file in files:
        assert file.read_bytes() == (street / file.relative_to(again)).read_bytes(), file
    assert not list(tmp_path.glob(".*"))


def test_rig_follows_the_papers_mounts():
    K = intrinsics(1920, 1300)
    np.testing.assert_allclose(K[0], [1662.77, 0, 960.0], atol=0.01)  # 959.5 with integer centres
    for name, mount in MOUNTS.items():
        viewmat = camera_viewmat(mount, (10.0, -1.75, 0.0))
        R, center = viewmat[:3, :3], -viewmat[:3, :3].T @ viewmat[:3, 3]
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(R) == pytest.approx(1.0)
        x, y, z = mount.location
        np.testing.assert_allclose(center, [10 + x, -1.75 - y, z], atol=1e-12)
        _, pitch, yaw = mount.rotation
        forward = R[2]  # right-handed, y left: a positive CARLA yaw turns to negative y
        assert np.rad2deg(np.arctan2(-forward[1], forward[0])) == pytest.approx(yaw, abs=1e-9)
        assert np.rad2deg(np.arcsin(forward[2])) == pytest.approx(pitch, abs=1e-9)
        assert R[1, 2] < -0.99, f"{name}: image y points down"
    np.testing.assert_allclose(carla_rotation(0, 0, 90) @ [1, 0, 0], [0, 1, 0], atol=1e-12)
    assert [image_height(w) for w in (1920, 480, 1)] == [1300, 325, 1]
    assert [image_height(w, multiple=4) for w in (320, 160)] == [216, 108]


def test_photographs_are_the_exposed_radiance_and_masks_agree_with_depth(street):
    lines = (street / "truth" / "exposures.csv").read_text().splitlines()
    rows = {row["image"]: row for row in csv.DictReader(lines)}
    assert list(rows) == NAMES
    checked, radiance = 0, []
    for name in NAMES:
        linear, depth = truth(street, name)
        radiance.append(linear)
        mask = read_png(street / "truth" / "sky_masks" / name)
        np.testing.assert_array_equal(mask, np.where(np.isinf(depth), 255, 0))
        assert depth.min() > 0.5
        reference = read_png(street / "reference" / name)
        shot = read_png(street / "images" / name)
        assert shot.shape == (SIZE["height"], SIZE["width"], 3)
        np.testing.assert_allclose(255 * srgb_encode(linear), reference, atol=0.51)
        np.testing.assert_array_equal(shot, photograph(linear, float(rows[name]["exposure"])))
        e = float(rows[name]["exposure"])
        assert e == int(rows[name]["iso"]) / 8
        assert float(rows[name]["exposure_ev"]) == pytest.approx(np.log2(e), abs=1e-5)
        good = (reference > 40) & (reference < 250) & (shot > 40) & (shot < 250)
        if good.sum() > 500:
            ratio = srgb_decode(shot[good] / 255) / srgb_decode(reference[good] / 255)
            assert np.median(ratio) == pytest.approx(e, rel=0.01)
            checked += 1
    assert checked >= len(NAMES) // 2
    linear = np.stack(radiance)
    assert np.isfinite(linear).all()
    low, high = np.percentile(linear, [0.05, 99.95])
    assert linear.min() >= 0
    assert high / low > 1000
    assert ((linear > 0.02) & (linear < 1.0)).mean() > 0.6


def test_pycolmap_reads_the_model_that_was_written(street, scene):
    card = json.loads((street / "dataset.json").read_text())
    model = pycolmap.Reconstruction(str(street / "sparse" / "0"))
    assert model.is_valid()
    assert model.num_cameras() == 3
    assert model.num_points3D() == card["points"]
    assert model.compute_num_observations() == card["observations"]
    model.update_point_3d_errors()
    assert model.compute_mean_reprojection_error() < 1e-6
    assert [v.name for v in scene.views] == NAMES
    K, track = intrinsics(SIZE["width"], SIZE["height"]), drive(SIZE["frames"])
    for view in scene.views:
        viewmat = camera_viewmat(MOUNTS[view.camera], track[int(Path(view.name).stem)])
        np.testing.assert_allclose(view.viewmat, viewmat, atol=1e-5)
        np.testing.assert_allclose(view.K, K, rtol=1e-6)


def test_tracks_are_projections_of_their_points_and_see_one_radiance(street, scene):
    tracks = scene.tracks
    local_log = np.full(len(tracks.xy), np.nan)
    for i, view in enumerate(scene.views):
        rows = np.flatnonzero(tracks.view_indices == i)
        p = scene.points[tracks.point_indices[rows]] @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]
        np.testing.assert_allclose(((p / p[:, 2:]) @ view.K.T)[:, :2], tracks.xy[rows], atol=0.02)
        reference = srgb_decode(read_png(street / "reference" / view.name) / 255.0)
        u, v = tracks.xy[rows].T - 0.5
        value = map_coordinates(reference[..., 1], [v, u], order=1, mode="nearest")
        usable = (value > 0.01) & (value < 0.95)
        local_log[rows[usable]] = np.log2(value[usable])
    order = np.argsort(tracks.point_indices, kind="stable")
    point, value = tracks.point_indices[order], local_log[order]
    neighbours = (point[1:] == point[:-1]) & np.isfinite(value[1:]) & np.isfinite(value[:-1])
    assert neighbours.sum() > 5000
    assert np.median(np.abs(np.diff(value)[neighbours])) < 0.1
    assert len(tracks.xy) / len(scene.points) > 3


def test_seed_colours_come_from_training_views(street, scene):
    found = np.zeros(len(scene.points), bool)
    for i, view in enumerate(scene.views):
        if view.name.endswith("000000.png"):
            continue
        rows = np.flatnonzero(scene.tracks.view_indices == i)
        ids = scene.tracks.point_indices[rows]
        x, y = np.floor(scene.tracks.xy[rows]).astype(int).T
        colors = read_png(view.image_path)[y, x]
        centred = np.abs(scene.tracks.xy[rows] % 1.0 - 0.5).max(1) < 1e-3
        found[ids[centred & (colors == scene.point_colors[ids]).all(1)]] = True
    assert found.all()


@pytest.mark.parametrize("length_m", [90.0, 120.0, 226.0, 300.0])
def test_a_long_town_goes_on_as_far_as_the_drive_and_ends_behind_it(length_m):
    town = build_town(3, "long", length_m)
    houses = np.asarray(town.material) == Material.FACADE
    reached = np.sort(town.lo[houses, 0])
    assert reached[-1] > length_m
    assert np.diff(reached).max() < 25, "only side streets part the houses"
    x = np.linspace(0, length_m + 3, 200)
    eyes = np.stack([x, np.full_like(x, -1.75), np.full_like(x, 3.845)], 1)[:, None]
    assert not ((eyes > town.lo[houses]) & (eyes < town.hi[houses])).all(-1).any()
    if length_m > 2 * STREET_M:
        # No two streets are alike.
        first = town.color[houses & (town.lo[:, 0] < STREET_M - 22)]
        assert not np.array_equal(first, town.color[houses][len(first) : 2 * len(first)])


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"frames": 0}, "cannot be rendered"),
        ({"frames": 101, "step": 1.2}, r"101 frames with a step of 1\.2 m need 120 m"),
        ({"frames": 101, "step": 1.2, "layout": "town"}, "--layout long"),
    ],
)
def test_impossible_drives_are_refused(street, tmp_path, options, words):
    with pytest.raises(UserError, match=words):
        write_street(tmp_path / "x", **options)
    assert not (tmp_path / "x").exists()
    with pytest.raises(UserError, match="not an empty folder"):
        write_street(street)


def test_photographs_can_come_from_another_renderer(tmp_path):
    def wall(views):
        for row in range(len(views.names)):
            yield np.full((64, 96, 3), 0.1 + 0.01 * row, np.float32), np.full((64, 96), 10.0)

    size = {"frames": 2, "width": 96, "height": 64, "points": 50, "hold_out": 0}
    scene = write_street(tmp_path / "scene", render=wall, **size)
    exposures = read_true_exposures(scene)
    for row, name in enumerate(sorted(exposures)):
        expected = photograph(np.full((64, 96, 3), 0.1 + 0.01 * row, np.float32), exposures[name])
        np.testing.assert_array_equal(read_png(scene / "images" / name), expected)


def test_the_card_and_the_table_hold_seed_and_sensor(street, tmp_path):
    card = json.loads((street / "dataset.json").read_text())
    assert (card["seed"], card["sensor"]["iso_std"]) == (SIZE["seed"], 4.0)
    sensor = Sensor(iso_std=2.0, camera_gain_ev=0.3, white_balance_ev=0.1, vignetting=0.2)
    shots = draw_shots(sensor, SIZE["frames"], 3, seed=5)
    (tmp_path / "truth").mkdir()
    write_true_exposures(tmp_path, NAMES, shots)
    read = read_true_exposures(tmp_path)
    assert list(read) == NAMES
    assert list(read.values()) == pytest.approx(shots.mean_exposures, rel=1e-5)
    rows = list(csv.DictReader((tmp_path / "truth" / "exposures.csv").read_text().splitlines()))
    assert {row["corners"] for row in rows} == {"0.8"}
    balances = {tuple(float(row[c]) for c in ("red", "green", "blue")) for row in rows}
    assert len(balances) == 3
    assert np.prod(list(balances), axis=1) == pytest.approx(1, abs=1e-4)
    assert read_true_exposures(street / "images") == {}
