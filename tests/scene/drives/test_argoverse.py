"""Argoverse 2: logs written by the published schema."""

import re
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import feather
from scene.drives.writers import (
    HEIGHT,
    WIDTH,
    applied,
    car_at,
    cut,
    landmarks,
    matrix,
    mounted,
    write_jpeg,
    wxyz,
)
from scipy.spatial.transform import Rotation

from p2gs_jax.config import DataConfig
from p2gs_jax.errors import UserError
from p2gs_jax.scene import load_scene
from p2gs_jax.scene.drives import arrow
from p2gs_jax.scene.drives.argoverse import is_argoverse, read_argoverse
from p2gs_jax.scene.drives.assemble import assemble
from p2gs_jax.scene.rigid import inverse

START = 315968112437425433
CAMERAS = {
    "ring_front_center": 0.0,
    "ring_front_left": 0.9,
    "ring_side_right": -1.6,
    "stereo_front_left": 0.0,
}
# Exposures are centred on the scanners' passing, every half turn.
LAG = {"ring_front_center": 0.02, "ring_front_left": 0.008, "ring_side_right": 0.04}
CFG = DataConfig()


def ns(seconds: float) -> int:
    return START + round(seconds * 1e9)


def read(root, cfg=CFG):
    return read_argoverse(root, cfg, lambda message: None)


def write(path: Path, **columns) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    feather.write_feather(pa.table(columns), path, compression="lz4")


def posed(poses) -> dict:
    quaternions = np.array([wxyz(pose) for pose in poses]).reshape(-1, 4)
    positions = np.array([pose[:3, 3] for pose in poses]).reshape(-1, 3)
    names = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
    return dict(zip(names, np.hstack([quaternions, positions]).T, strict=True))


BOX = matrix(Rotation.from_euler("z", 0.5), [12, -3, 0.8])


def write_boxes(log: Path, turns: int, **changes) -> None:
    """Write one thing that keeps its place before the car, and one that stands in the world."""
    standing = [inverse(car_at(0.1 * k)) @ car_at(0) @ BOX for k in range(turns)]
    columns = {
        "timestamp_ns": [ns(0.1 * k) for k in range(turns)] * 2,
        "track_uuid": ["followed"] * turns + ["standing"] * turns,
        "category": ["REGULAR_VEHICLE"] * turns + ["BOLLARD"] * turns,
        "length_m": [4.0] * turns + [0.3] * turns,
        "width_m": [2.0] * turns + [0.3] * turns,
        "height_m": [1.5] * turns + [1.0] * turns,
        **posed([BOX] * turns + standing),
        "num_interior_pts": [9] * 2 * turns,
    }
    write(log / "annotations.feather", **(columns | changes))


def write_log(log: Path, turns=4) -> Path:
    # Of 100 Hz, with one moment told twice, a nanosecond apart, as in published logs.
    moments = sorted([-0.05 + 0.01 * k for k in range(10 * turns + 10)] + [0.1 + 1e-9])
    write(
        log / "city_SE3_egovehicle.feather",
        timestamp_ns=[ns(t) for t in moments],
        **posed([car_at(t) for t in moments]),
    )
    mounts = {name: mounted(azimuth) for name, azimuth in CAMERAS.items()}
    mounts["up_lidar"] = matrix(Rotation.identity(), [1.35, 0, 1.64])
    write(
        log / "calibration" / "egovehicle_SE3_sensor.feather",
        sensor_name=list(mounts),
        **posed(list(mounts.values())),
    )
    n = len(CAMERAS)
    write(
        log / "calibration" / "intrinsics.feather",
        sensor_name=list(CAMERAS),
        fx_px=[50.0] * n,
        fy_px=[51.0] * n,
        cx_px=[31.5] * n,
        cy_px=[23.5] * n,
        k1=[-0.25] * n,
        k2=[-0.2] * n,
        k3=[0.3] * n,
        height_px=[HEIGHT] * n,
        width_px=[WIDTH] * n,
    )
    for turn in range(turns):
        start = 0.1 * turn
        for name, lag in LAG.items():
            for half in (0, 0.05):
                stamp = ns(start + half + lag)
                write_jpeg(log / "sensors" / "cameras" / name / f"{stamp}.jpg")
        write_jpeg(log / "sensors" / "cameras" / "stereo_front_left" / f"{ns(start)}.jpg")
        local = applied(inverse(car_at(start)), landmarks())
        write(
            log / "sensors" / "lidar" / f"{ns(start)}.feather",
            **{axis: local[:, k].astype(np.float16) for k, axis in enumerate("xyz")},
            intensity=np.zeros(len(local), np.uint8),
            laser_number=np.zeros(len(local), np.uint8),
            offset_ns=np.linspace(0, 1e8, len(local)).astype(np.int32),
        )
    write_boxes(log, turns)
    return log


@pytest.fixture
def log(tmp_path):
    return write_log(tmp_path / "7fab2350-7eaf-3b7e-a39d-6937a4c1bede")


def test_each_photograph_has_its_own_time_and_pose(log):
    assert is_argoverse(log)
    assert is_argoverse(log.parent)
    assert not is_argoverse(log / "sensors")
    drive = read(log)
    assert [c.name for c in drive.cameras] == list(LAG)
    for camera in drive.cameras:
        np.testing.assert_array_equal(camera.K, [[50, 0, 32], [0, 51, 24], [0, 0, 1]])
        assert (camera.width, camera.height) == (WIDTH, HEIGHT)
        # Photographs are published without the lens's distortion.
        assert camera.distortion is None
    assert len(drive.photographs) == 24
    for photograph in drive.photographs:
        stamp = int(photograph.path.stem)
        assert photograph.time == pytest.approx((stamp - ns(-0.05)) * 1e-9, abs=1e-9)
        seconds = (stamp - START) * 1e-9
        expected = car_at(seconds) @ mounted(CAMERAS[photograph.camera])
        np.testing.assert_allclose(photograph.pose, expected, atol=1e-3)
    for name in LAG:
        assert sorted(p.frame for p in drive.photographs if p.camera == name) == list(range(8))


def test_the_grey_pair_is_read_where_it_is_asked_for(log):
    assert "stereo" in read(log).notes[0]
    drive = read(log, DataConfig(cameras=("stereo_front_left",)))
    assert drive.cameras[-1].name == "stereo_front_left"
    assert not any("stereo" in note for note in drive.notes)


def test_laser_points_are_in_the_world_at_their_own_time(log):
    drive = read(log)
    assert [s.frame for s in drive.sweeps] == [0, 2, 4, 6]
    for sweep in drive.sweeps:
        points, times = sweep.read()
        np.testing.assert_allclose(points, landmarks(), atol=0.03)
        assert times[0] == pytest.approx(sweep.time)
        assert times[-1] == pytest.approx(sweep.time + 0.1)


def test_boxes_become_tracks_in_the_world(log):
    followed, standing = read(log).objects
    assert (followed.name, followed.label) == ("followed", "REGULAR_VEHICLE")
    assert followed.size == (4, 2, 1.5)
    assert followed.moving
    assert not standing.moving
    np.testing.assert_allclose(followed.times, 0.05 + 0.1 * np.arange(4), atol=1e-9)
    for k in range(4):
        np.testing.assert_allclose(followed.poses[k], car_at(0.1 * k) @ BOX, atol=1e-3)
        np.testing.assert_allclose(standing.poses[k], car_at(0) @ BOX, atol=1e-3)


def test_a_log_of_several_is_named(log):
    write_log(log.parent / "adcf7d18-0510-35b0-a2fa-b4cea13a6d76", turns=1)
    with pytest.raises(UserError, match="holds 2 drives"):
        read(log.parent)
    assert len(read(log.parent, DataConfig(drive="adcf")).photographs) == 6


def test_it_is_found_and_read_as_a_scene(log):
    scene = load_scene(log, DataConfig(frames="0:4", cameras=("front_center", "front_left")))
    assert scene.format == "argoverse"
    assert len(scene.views) == 8
    assert len(scene.objects) == 2
    assert scene.lidar is not None
    assert max(np.abs(scene.origin)) > 500
    assert np.abs(scene.points).max() < 100


def test_one_turn_is_enough(tmp_path):
    drive = read(write_log(tmp_path, turns=1))
    assert len(assemble(drive, CFG).views) == 6


def test_what_is_missing_is_counted(log):
    for path in (log / "sensors" / "cameras" / "ring_side_right").iterdir():
        path.unlink()
    write_jpeg(log / "sensors" / "cameras" / "ring_front_left" / f"{ns(-9)}.jpg")
    write_jpeg(log / "sensors" / "cameras" / "ring_rear_left" / f"{ns(0)}.jpg")
    sweep = next(iter((log / "sensors" / "lidar").iterdir()))
    sweep.rename(sweep.with_name(f"{ns(-8)}.feather"))
    stamps = [ns(0), ns(0.1), ns(99), ns(0.1)]
    write_boxes(log, 2, timestamp_ns=stamps, track_uuid=["a", None, "c", ""])
    drive = read(log)
    assert len(drive.photographs) == 16
    assert len(drive.sweeps) == 3
    assert [t.name for t in drive.objects] == ["a"]
    assert drive.notes[1:] == (
        "calibration/intrinsics.feather has no row for ring_rear_left: left out.",
        "There are no photographs of ring_side_right.",
        "1 photographs are outside city_SE3_egovehicle.feather: they are left out.",
        "1 LiDAR sweeps are outside city_SE3_egovehicle.feather.",
        "2 boxes belong to no track: they are left out.",
        "1 boxes are outside city_SE3_egovehicle.feather: they are left out.",
    )


def test_without_boxes_nothing_is_known_to_move(log):
    (log / "annotations.feather").unlink()
    drive = read(log)
    assert drive.objects == ()
    assert "what moves is not known" in drive.notes[-1]


@pytest.mark.parametrize(
    "name",
    [
        "city_SE3_egovehicle.feather",
        "calibration/intrinsics.feather",
        "calibration/egovehicle_SE3_sensor.feather",
        "annotations.feather",
    ],
)
def test_broken_tables_are_named(log, name):
    cut(log / name)
    with pytest.raises(UserError, match=re.escape(name)):
        read(log)
    write(log / name, other=[1])
    with pytest.raises(UserError, match="has no column"):
        read(log)
    if "calibration" in name:
        (log / name).unlink()
        with pytest.raises(UserError, match=re.escape(f"{name} is missing")):
            read(log)


def test_broken_sweeps_are_named_when_they_are_read(log):
    sweep = read(log).sweeps[0]
    path = log / "sensors" / "lidar" / f"{ns(0)}.feather"
    cut(path)
    with pytest.raises(UserError, match=path.name):
        sweep.read()
    path.unlink()
    with pytest.raises(UserError, match=f"{path.name} is missing"):
        sweep.read()


def test_senseless_values_are_named(log):
    path = log / "calibration" / "egovehicle_SE3_sensor.feather"
    good = feather.read_table(path).to_pydict()
    write(path, **(good | {"qw": [9.0] * len(good["qw"])}))
    with pytest.raises(UserError, match="sensor number 1 is no unit quaternion"):
        read(log)
    write(path, **{name: column[1:] for name, column in good.items()})
    with pytest.raises(UserError, match="where ring_front_center is"):
        read(log)
    write(path, **good)
    path = log / "calibration" / "intrinsics.feather"
    good = feather.read_table(path).to_pydict()
    for wrong, words in (([0.0] * 4, "should be positive"), (["x"] * 4, "should hold numbers")):
        write(path, **(good | {"fx_px": wrong}))
        with pytest.raises(UserError, match=words):
            read(log)
    write(path, **good)
    for changes, words in (
        ({"width_m": [0.0] * 4}, "has no size"),
        ({"timestamp_ns": [0.5] * 4}, "should be whole numbers"),
        ({"timestamp_ns": [None, ns(0), ns(0), ns(0)]}, "without gaps"),
    ):
        write_boxes(log, 2, **changes)
        with pytest.raises(UserError, match=words):
            read(log)
    write_boxes(log, 2)
    path = log / "city_SE3_egovehicle.feather"
    write(path, **{n: c[:0] for n, c in feather.read_table(path).to_pydict().items()})
    with pytest.raises(UserError, match=r"city_SE3_egovehicle\.feather"):
        read(log)


def test_without_pyarrow_the_command_is_said(log, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(UserError, match=r"pip install 'p2gs-jax\[drives\]'"):
        arrow.read_feather(log / "annotations.feather", [])
