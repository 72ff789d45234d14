"""What every reader promises (`scene/drives/recording.py`), asked of made drives of all formats."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import feather, parquet
from scene.drives import (
    writers_argoverse,
    writers_kitti,
    writers_nuscenes,
    writers_pandaset,
    writers_waymo,
)
from scene.drives.writers import HEIGHT, WIDTH, car_at, cut

from p2gs_jax.config import DataConfig
from p2gs_jax.errors import UserError
from p2gs_jax.scene import load_scene
from p2gs_jax.scene.drives import FORMATS, read_drive

EVERY = pytest.mark.parametrize("name", FORMATS)


@EVERY
def test_a_drive_is_recognised_and_every_photograph_has_its_own_time_and_pose(kept, read, name):
    made = kept(name)
    assert [n for n, reader in FORMATS.items() if reader.recognise(made.root)] == [name]
    recording = read(made.root)
    assert recording.format == name
    found = {(p.camera, p.frame): p for p in recording.photographs}
    assert len(recording.photographs) == len(found)
    assert found.keys() == made.photographs.keys()
    for key, (time, pose) in made.photographs.items():
        assert found[key].time == pytest.approx(time, abs=2e-6)
        np.testing.assert_allclose(found[key].pose, pose, atol=5e-3)
    assert {c.name for c in recording.cameras} == {camera for camera, _ in found}
    for camera in recording.cameras:
        fx, fy, cx, cy = made.K
        np.testing.assert_allclose(camera.K, [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], atol=1e-9)
        assert (camera.width, camera.height) == (WIDTH, HEIGHT)


@EVERY
def test_laser_points_lie_where_they_were_at_their_own_time(kept, read, name):
    made = kept(name)
    sweeps = read(made.root).sweeps
    np.testing.assert_allclose([s.time for s in sweeps], made.sweeps, atol=2e-6)
    assert (np.diff([s.time for s in sweeps]) > 0).all()
    for sweep in sweeps:
        points, times = sweep.read()
        assert len(points) == len(times) == made.count
        assert made.error(points).max() < 0.04
        assert np.abs(times - sweep.time).max() <= 0.1001


@EVERY
def test_boxes_have_the_time_at_which_the_scanner_passed_them(kept, read, name):
    made = kept(name)
    found = {re.sub("^(scene-0001 |[0-9])", "", t.name): t for t in read(made.root).objects}
    if name == "kitti_raw":
        # Its tracks are numbered; the label is all that they have.
        found = {t.label: t for t in read(made.root).objects}
    assert found.keys() == {"ahead", "right", "parked"}
    assert {k: t.moving for k, t in found.items()} == {
        "ahead": True,
        "right": True,
        "parked": False,
    }
    for key, (times, poses) in made.boxes.items():
        assert found[key].size == pytest.approx((4.2, 1.8, 1.5))
        np.testing.assert_allclose(found[key].times, times, atol=2e-6)
        np.testing.assert_allclose(found[key].poses, poses, atol=5e-3)
    still = found["parked"].poses[:, :3, 3]
    assert np.abs(still - still[0]).max() < 0.4


@EVERY
def test_one_frame_is_enough_and_becomes_a_scene(write, tmp_path, name):
    made = write(name, tmp_path / "drive", frames=1)
    scene = load_scene(made.root, DataConfig(), work_dir=tmp_path / "work")
    assert scene.format == name
    assert len(scene.views) == {"argoverse": 6, "waymo": 3}.get(name, 2)
    assert scene.lidar is not None
    assert all(view.image_path.is_file() for view in scene.views)


@pytest.mark.parametrize(
    ("name", "part"),
    [("argoverse", "drive"), ("pandaset", "drive"), ("kitti_raw", writers_kitti.DRIVE)],
)
def test_one_of_several_drives_has_to_be_named(copied, read, name, part):
    made = copied(name)
    first = made.root if part == "drive" else made.root / part
    shutil.copytree(first, first.with_name(f"{part}_other"))
    with pytest.raises(UserError, match=f"holds 2 drives: {part}, {part}_other"):
        read(first.parent)
    other = read(first.parent, drive=f"{part}_o")
    assert len(other.photographs) == len(made.photographs)
    assert all(f"{part}_other" in str(p.path) for p in other.photographs)


@EVERY
def test_a_table_that_is_cut_off_or_gone_is_named(copied, read, name):
    made = copied(name)
    for table in made.tables + made.optional:
        whole = (made.root / table).read_bytes()
        cut(made.root / table)
        # A text that is cut may still be a table, of fewer frames.
        if table.suffix != ".txt":
            with pytest.raises(UserError, match=re.escape(table.name)):
                read(made.root)
        (made.root / table).unlink()
        if table in made.optional:
            assert read(made.root).notes or "lidar" in table.parts
        elif FORMATS[name].recognise(made.root):
            with pytest.raises(UserError, match=re.escape(f"{table.name} is missing")):
                read(made.root)
        (made.root / table).write_bytes(whole)


@EVERY
def test_reading_decodes_nothing(copied, read, name):
    made = copied(name)
    for file in made.scans:
        (made.root / file).write_bytes(b"never read")
    # The size of one photograph a camera is looked at, in sets that do not tell it.
    for path in made.root.rglob("*.jpg"):
        if path != min(path.parent.iterdir()):
            path.write_bytes(b"never read")
    drive = read(made.root)
    assert len(drive.photographs) == len(made.photographs)
    assert len(drive.sweeps) == len(made.sweeps)


@EVERY
def test_a_broken_sweep_is_named_when_it_is_read(copied, read, name):
    made = copied(name)
    for scan in made.scans:
        held = (made.root / scan).read_bytes()
        (made.root / scan).write_bytes(held[: len(held) // 2 + 1])
    for sweep in read(made.root).sweeps if made.scans else ():
        with pytest.raises(UserError) as error:
            sweep.read()
        assert any(scan.name in error.value.message for scan in made.scans)


@EVERY
def test_damaged_files_end_in_a_recording_or_a_complaint(copied, read, name):
    """Files are cut, changed or shortened; a recording that is read nevertheless is sound."""
    root = copied(name).root
    rng = np.random.default_rng(1)
    pictures = (".png", ".jpg")
    files = sorted(p for p in root.rglob("*") if p.is_file() and p.suffix not in pictures)
    complaints = 0
    for _ in range(40):
        path = files[rng.integers(len(files))]
        whole = path.read_bytes()
        damaged = bytearray(whole)
        at = rng.integers(len(whole))
        match rng.integers(4):
            case 0:
                damaged = damaged[:at]
            case 1:
                damaged[at] = rng.integers(256)
            case 2:
                del damaged[at : at + rng.integers(1, 30)]
            case _:
                damaged = damaged.replace(b"0", b"nan", 2)
        path.write_bytes(damaged)
        try:
            recording = read_drive(root, DataConfig())
            for sweep in recording.sweeps if recording else ():
                sweep.read()
            for photograph in recording.photographs if recording else ():
                assert np.isfinite(photograph.pose).all()
            for thing in recording.objects if recording else ():
                assert np.isfinite(thing.poses).all()
                assert (np.diff(thing.times) > 0).all()
        except UserError:
            complaints += 1
        path.write_bytes(whole)
    assert complaints > 4


# ------------------------------------------------------------- values that make no sense, by table

IMAGES, POSES, BOXES = "sample_data", "calibrated_sensor", "sample_annotation"


def first(**changes):
    return lambda rows: [{**rows[0], **changes}, *rows[1:]]


def every(**changes):
    return lambda rows: [{**row, **changes} for row in rows]


def without_first(rows):
    return rows[1:]


NUSCENES = [
    (POSES, first(rotation=[2, 0, 0, 0]), "no unit quaternion"),
    (POSES, first(rotation=[1, 0, 0]), "should be 4 numbers, not 3"),
    (POSES, first(translation=["x", 0, 0]), "finite numbers"),
    (POSES, first(camera_intrinsic=[[1, 2], [3]]), "9 numbers"),
    (POSES, first(camera_intrinsic=[[0] * 3] * 3), "is not a camera matrix"),
    (POSES, without_first, "no sensor calibrated CAM_FRONT"),
    ("sensor", without_first, "no sensor CAM_FRONT"),
    ("sample", first(timestamp="now"), "no valid 'timestamp'"),
    ("sample", lambda rows: [], "no sample of scene-0001"),
    (IMAGES, every(width=None), "the size of samples/CAM_FRONT"),
    ("ego_pose", first(rotation=[float("nan")] * 4), "finite numbers"),
    (BOXES, first(size=[1, 0, 1]), "has no size"),
    (BOXES, first(rotation="up"), "no valid 'rotation'"),
    ("scene", lambda rows: {}, "is not a valid table"),
    ("scene", lambda rows: [1], "is not a valid table"),
]


@pytest.mark.parametrize(("table", "change", "words"), NUSCENES)
def test_nuscenes(copied, read, table, change, words):
    root = copied("nuscenes").root
    path = root / writers_nuscenes.TABLES / f"{table}.json"
    path.write_text(json.dumps(change(json.loads(path.read_text()))))
    refused(read, root, words, path.name)


def refused(read, root, words, name):
    with pytest.raises(UserError, match=words) as error:
        read(root)
    assert name in error.value.message


ARGOVERSE = [
    (writers_argoverse.EXTRINSICS, {"qw": [9.0] * 5}, "sensor number 1 is no unit quaternion"),
    (writers_argoverse.EXTRINSICS, {"sensor_name": ["a"] * 5}, "where ring_front_center is"),
    (writers_argoverse.INTRINSICS, {"fx_px": [0.0] * 4}, "should be positive"),
    (writers_argoverse.INTRINSICS, {"fx_px": ["x"] * 4}, "should hold numbers"),
    (writers_argoverse.BOXES, {"width_m": [0.0] * 9}, "has no size"),
    (writers_argoverse.BOXES, {"timestamp_ns": [0.5] * 9}, "should be whole numbers"),
    (writers_argoverse.BOXES, {"timestamp_ns": [None, *range(8)]}, "without gaps"),
    (writers_argoverse.BOXES, None, "has no column"),
    (writers_argoverse.POSES, None, "has no column"),
]


@pytest.mark.parametrize(("table", "changes", "words"), ARGOVERSE)
def test_argoverse(copied, read, table, changes, words):
    root = copied("argoverse").root
    columns = feather.read_table(root / table).to_pydict() if changes else {"other": [1]}
    writers_argoverse.write_table(root / table, **(columns | (changes or {})))
    refused(read, root, words, table.name)


LENS, BOX = writers_waymo.LENS, writers_waymo.BOX
MOUNT, FOCAL = f"{LENS}extrinsic.transform", f"{LENS}intrinsic.f_u"
WAYMO = [
    ("camera_calibration", {MOUNT: [2.0] * 16}, "the pose of SIDE_RIGHT is no rotation|of FRONT"),
    ("camera_calibration", {MOUNT: [1.0] * 9}, "no rotation"),
    ("camera_calibration", {MOUNT: np.diag([1.0, -1, 1, 1]).ravel().tolist()}, "mirrors"),
    ("camera_calibration", {FOCAL: 0.0}, "the lens of FRONT"),
    ("camera_calibration", {FOCAL: float("nan")}, "the lens of FRONT"),
    ("camera_calibration", {FOCAL: None}, "should hold numbers"),
    ("camera_calibration", {FOCAL: "50"}, "should hold numbers"),
    ("camera_calibration", {"key.camera_name": 8}, "has no camera SIDE_RIGHT"),
    ("camera_calibration", {"key.camera_name": None}, "without gaps"),
    ("lidar_box", {f"{BOX}box.size.x": 0.0}, "positive sizes"),
    ("lidar_box", {f"{BOX}box.heading": float("nan")}, "finite positions"),
    *((component, None, "has no column") for component in ("lidar", "lidar_pose", "vehicle_pose")),
]


@pytest.mark.parametrize(("component", "changes", "words"), WAYMO)
def test_waymo(copied, read, component, changes, words):
    root = copied("waymo").root
    if changes is None:
        parquet.write_table(pa.table({"other": [1]}), root / writers_waymo.file(component))
    elif component == "lidar_box":
        row = writers_waymo.box_row(0, "a", car_at(0), **changes)
        writers_waymo.write_rows(root, component, [row])
    else:
        writers_waymo.write_rows(root, component, [writers_waymo.lens_row(1, **changes)])
    refused(read, root, words, component)


FRONT, CUBOIDS = writers_pandaset.FRONT, writers_pandaset.CUBOIDS / "01.pkl.gz"
HALF = {"position": dict.fromkeys("xyz", 0)}
BENT = {**HALF, "heading": dict.fromkeys("wxyz", 1)}
PANDASET = [
    (FRONT / "poses.json", {}, "should hold a list"),
    (FRONT / "poses.json", [HALF], "the pose of frame 0 lacks"),
    (FRONT / "poses.json", [BENT], "the pose of frame 0 has a rotation that is no unit"),
    (FRONT / "intrinsics.json", {"fx": 60}, "lacks"),
    (FRONT / "timestamps.json", ["now", "then", "soon"], "entry 0 should be finite"),
    (CUBOIDS, {"label": None}, "no column 'label'"),
    (CUBOIDS, {"dimensions.x": "wide"}, "'dimensions.x' should hold numbers"),
    (CUBOIDS, {"dimensions.x": 0.0}, "positive sizes"),
]


@pytest.mark.parametrize(("table", "held", "words"), PANDASET)
def test_pandaset(copied, read, table, held, words):
    root = copied("pandaset").root
    if table == CUBOIDS:
        rows = [{**row, **held} for row in writers_pandaset.cuboids(1)]
        gone = [name for name, value in held.items() if value is None]
        rows = [{k: v for k, v in row.items() if k not in gone} for row in rows]
        writers_pandaset.write_rows(root / table, rows)
    else:
        writers_pandaset.put(root / table, held)
    refused(read, root, words, table.name)


OXTS, IMAGE = (f"{writers_kitti.DRIVE}/{part}" for part in ("oxts/data/0000000000.txt", "image_03"))
ONE = writers_kitti.tracklet("Car", 0, [[1, 2, 3, 0]])
KITTI = [
    ("calib_imu_to_velo.txt", "R: 1 0 0 0 1 0 0 0 2\nT: 0 0 0\n", "no rotation"),
    ("calib_cam_to_cam.txt", "R_rect_00: 1 0 0 0 1 0 0 0 1\n", "P_rect_02 of 3x4"),
    ("calib_cam_to_cam.txt", "R_rect_00: 1 0 0\n", "R_rect_00 of 3x3"),
    (f"{IMAGE}/timestamps.txt", "yesterday\n", "'yesterday' is not a date"),
    (OXTS, "49 8.4 110", "holds 3 numbers"),
    (OXTS, "a b c d e f\n", "position"),
    (OXTS, "90 0 0 0 0 0\n", "no Mercator"),
    (writers_kitti.BOXES, writers_kitti.tracklets(ONE)[:80].decode(), "is not valid XML"),
    (writers_kitti.BOXES, writers_kitti.tracklets(ONE.replace("<h>1.5</h>", "")).decode(), "<h>"),
    (writers_kitti.BOXES, writers_kitti.tracklets(ONE.replace("1.8", "0")).decode(), "side of 0"),
]


@pytest.mark.parametrize(("table", "text", "words"), KITTI)
def test_kitti(copied, read, table, text, words):
    root = copied("kitti_raw").root
    (root / table).write_text(text)
    refused(read, root, words, Path(table).name)
