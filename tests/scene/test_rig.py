"""KITTI's files: ours come back as they were written, KITTI's own stereo pair as COLMAP has it."""

import shutil

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

from p2gs_jax.config import DataConfig
from p2gs_jax.errors import UserError
from p2gs_jax.scene import load_scene, rig
from p2gs_jax.scene.rig import load_rig
from p2gs_jax.synth.build_town import build_town
from p2gs_jax.synth.intersect import nearest_hit
from p2gs_jax.synth.lidar import Lidar, Scanner
from p2gs_jax.synth.write import write_street
from p2gs_jax.types import View

RIG = DataConfig(format="rig")


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    return write_street(
        tmp_path_factory.mktemp("rig") / "scene",
        frames=4,
        width=96,
        height=64,
        points=400,
        seed=1,
        layout="town",
        lidar=True,
    )


@pytest.fixture
def copy(street, tmp_path):
    return shutil.copytree(street.root, tmp_path / "scene")


def test_cameras_come_back(street):
    scene = load_scene(street.root, RIG)
    assert scene.format == "rig"
    assert [v.name for v in scene.views] == list(street.names)
    # KITTI's world is camera 0 of the first frame.
    world = street.viewmats[0]
    for view, viewmat in zip(scene.views, street.viewmats, strict=True):
        np.testing.assert_allclose(view.viewmat @ world, viewmat, atol=1e-4)
        np.testing.assert_allclose(view.K, street.K, atol=1e-4)


def test_lidar_points_lie_on_what_the_cameras_see_and_have_its_colour(street):
    scene = load_scene(street.root, RIG)
    assert len(scene.points) > 5000
    view, depth = scene.views[1], street.depth(1)
    local = scene.points @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]
    xy = (local @ view.K.T)[:, :2] / local[:, 2:]
    at = np.floor(xy).astype(int)
    inside = (local[:, 2] > 1) & np.all((at >= 1) & (at < [view.width - 1, view.height - 1]), 1)
    x, y = at[inside].T
    z = local[inside, 2]
    near = np.stack([depth[y + j, x + i] for i in (-1, 0, 1) for j in (-1, 0, 1)])
    # What is in front of the point hides it; nothing lies far in front of the surface.
    free = z < near.min(0) * 0.97
    assert free.mean() < 0.02
    assert np.mean(np.abs(near - z).min(0) < 0.03 * z) > 0.5
    assert scene.point_colors.std() > 20


def test_scans_are_the_first_hits_of_all_primitives(street):
    """Culling by sector loses nothing."""
    town = build_town(1, "town")
    vehicle = np.array([3.0, -1.75, 0.0])
    scanner = Scanner(town, Lidar(points_per_second=2e5))
    points = scanner.scan(vehicle)
    origin = (vehicle + scanner.lidar.mount).astype(np.float32)
    distance = np.linalg.norm(points, axis=1)
    directions = (points / distance[:, None]).T
    everything = np.ones(town.size, bool)
    t, _ = nearest_hit(town, origin[:, None], directions, everything)
    np.testing.assert_allclose(t, distance, rtol=1e-4, atol=1e-3)
    assert distance.max() <= 100
    elevation = np.rad2deg(np.arcsin(points[:, 2] / distance))
    assert elevation.min() == pytest.approx(-25, abs=0.01)
    assert elevation.max() <= 15.01
    assert Lidar().azimuths * 64 == pytest.approx(130_000, rel=0.02)


def test_kitti_stereo_is_read_as_colmap_reads_it(shared_data):
    folder = shared_data("kitti_stereo_a")
    rig = load_rig(folder, DataConfig())
    colmap = load_scene(folder, DataConfig(format="colmap"))
    assert rig.views[0].camera == "left"

    # Relative poses: the model's world may differ, and its principal point is not shifted.
    def relative(views, a, b):
        return views[a].viewmat.astype(float) @ np.linalg.inv(views[b].viewmat.astype(float))

    by_name = {v.name: i for i, v in enumerate(colmap.views)}
    pairs = [(0, 5), (0, 45), (40, 41)]
    for a, b in pairs:
        i, j = (by_name[rig.views[k].name] for k in (a, b))
        np.testing.assert_allclose(
            relative(rig.views, a, b), relative(colmap.views, i, j), atol=2e-3
        )
    assert len(rig.points) == 0


def test_one_point_per_voxel(street):
    scene = load_scene(street.root, RIG)
    distance = cKDTree(scene.points).query(scene.points, k=2)[0][:, 1]
    assert np.median(distance) > 0.02
    assert any("thinned" in note for note in scene.notes)


def test_a_view_may_see_more_points_than_an_image_is_wide(tmp_path):
    """OpenCV samples at no more than 32,766 positions; a LiDAR sees more."""
    ramp = np.tile(np.arange(240, dtype=np.uint8)[None, :, None], (200, 1, 3))
    path = tmp_path / "ramp.png"
    cv2.imwrite(str(path), ramp)
    K = np.array([[100, 0, 120], [0, 100, 100], [0, 0, 1]], np.float32)
    view = View("ramp.png", path, "0", np.eye(4, dtype=np.float32), K, 240, 200)
    v, u = np.mgrid[5:195, 5:235] + 0.5
    points = np.stack([(u - 120) / 100, (v - 100) / 100, np.ones_like(u)], -1).reshape(-1, 3)
    assert len(points) > 32_767
    seen, colors, unseen = rig._colored(points.astype(np.float32), (view,), DataConfig())
    assert unseen == 0
    assert len(seen) == len(points)
    np.testing.assert_allclose(colors[:, 0].astype(float), u.ravel() - 0.5, atol=1)


@pytest.mark.parametrize(
    ("file", "line", "message"),
    [
        ("poses.txt", "1 0 0 0 0 1 0 0 0 0 0 0", "poses.txt, line 1: no rotation"),
        ("poses.txt", "2 0 0 0 0 2 0 0 0 0 2 0", "poses.txt, line 1: no rotation"),
        ("poses.txt", "1 0 0 1e308 0 1 0 0 0 0 1 0", "poses.txt, line 1: not 12 finite numbers"),
        ("calib.txt", "P0: 0 0 5 0 0 9 5 0 0 0 1 0", "calib.txt, line 1: no projection"),
    ],
)
def test_matrices_that_have_no_inverse_are_named(copy, file, line, message):
    rest = (copy / file).read_text().splitlines()[1:]
    (copy / file).write_text("\n".join([line, *rest]) + "\n")
    with pytest.raises(UserError, match=message):
        load_rig(copy, DataConfig())


def test_what_is_wrong_is_named(copy):
    calibration = (copy / "calib.txt").read_text()
    (copy / "calib.txt").write_text(calibration.replace("P1:", "Q1:"))
    with pytest.raises(UserError, match="no P1"):
        load_rig(copy, DataConfig())
    (copy / "calib.txt").write_text(calibration.replace("e+00", "e+00 x", 1))
    with pytest.raises(UserError, match="line 1"):
        load_rig(copy, DataConfig())
    (copy / "calib.txt").write_text(calibration)
    missing = copy / "images" / "front" / "000002.png"
    moved = missing.with_name("other.png")
    missing.rename(moved)
    with pytest.raises(UserError, match="not the number of a row"):
        load_rig(copy, DataConfig())
    moved.unlink()
    with pytest.raises(UserError, match="do not exist"):
        load_rig(copy, DataConfig())
    scene = load_rig(copy, DataConfig(allow_missing=True))
    assert len(scene.views) == 11
    (copy / "velodyne" / "000001.bin").write_bytes(b"1234567")
    with pytest.raises(UserError, match="no LiDAR scan"):
        load_rig(copy, DataConfig(allow_missing=True))
    with pytest.raises(UserError, match="format 'transforms'"):
        load_scene(copy, DataConfig(format="transforms"))
