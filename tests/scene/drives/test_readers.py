"""Promises of every reader (`scene/drives/recording.py`), tested on made drives of all formats."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import feather, parquet
from scene.drives import writers_argoverse as argoverse
from scene.drives import writers_drivestudio as drivestudio
from scene.drives import writers_kitti as kitti
from scene.drives import writers_kitti_tracking as tracking
from scene.drives import writers_nuscenes as nuscenes
from scene.drives import writers_pandaset as pandaset
from scene.drives import writers_waymo as waymo
from scene.drives.writers import HEIGHT, WIDTH, K, cut, mounted
from scene.helpers import refused

from p2gs_jax import UserError, load_scene
from p2gs_jax.config import DataConfig
from p2gs_jax.scene.drives import FORMATS

EVERY = pytest.mark.parametrize("name", FORMATS)


@EVERY
def test_photographs_laser_points_and_boxes_have_their_own_times_and_places(kept, read, name):
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
        fx, fy, cx, cy = K
        np.testing.assert_allclose(camera.K, [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], atol=1e-9)
        assert (camera.width, camera.height) == (WIDTH, HEIGHT)
    sweeps = recording.sweeps
    np.testing.assert_allclose([s.time for s in sweeps], made.sweeps, atol=2e-6)
    assert (np.diff([s.time for s in sweeps]) > 0).all()
    for sweep in sweeps:
        points, times = sweep.read()
        assert len(points) == len(times) == made.count
        assert made.error(points).max() < 0.04
        assert np.abs(times - sweep.time).max() <= 0.1001
    # Boxes have the time at which the scanner passed them; KITTI's tracks are numbered.
    found = {re.sub("^(scene-0001 |[0-9])", "", t.name): t for t in recording.objects}
    if name.startswith("kitti"):
        found = {t.label: t for t in recording.objects}
    assert found.keys() == {"ahead", "right", "parked"}
    assert {name for name, thing in found.items() if thing.moving} == {"ahead", "right"}
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
    [
        *[(name, "drive") for name in ("argoverse", "pandaset", "drivestudio")],
        ("kitti_raw", kitti.DRIVE),
    ],
)
def test_one_of_several_drives_has_to_be_named(copied, read, name, part):
    made = copied(name)
    first = made.root if part == "drive" else made.root / part
    shutil.copytree(first, first.with_name(f"{part}_other"))
    with refused(f"holds 2 drives: {part}, {part}_other"):
        read(first.parent)
    with refused(f"2 drives of .* begin with '{part[:-1]}'", "--drive NAME"):
        read(first.parent, drive=part[:-1])
    with refused(f"no drive 'other'; there are {part}, {part}_other"):
        read(first.parent, drive="other")
    with refused(f"{first} is one drive, whose name does not contain 'x'", "leave out --drive"):
        read(first, drive="x")
    (linked := first.with_name("linked")).symlink_to(first)
    assert all(len(read(linked, drive=d).photographs) for d in (part, "linked"))
    other = read(first.parent, drive=f"{part}_o")
    assert len(other.photographs) == len(made.photographs)
    assert all(f"{part}_other" in str(p.path) for p in other.photographs)


@EVERY
def test_a_table_that_is_cut_off_or_gone_is_named(copied, read, name):
    made = copied(name)
    for table in made.tables + made.optional:
        whole = (made.root / table).read_bytes()
        cut(made.root / table)
        # A text file that is cut may still be a valid table of fewer frames.
        if table.suffix != ".txt":
            with refused(re.escape(table.name)):
                read(made.root)
        (made.root / table).unlink()
        if table in made.optional:
            assert read(made.root).notes or "lidar" in table.parts
        elif FORMATS[name].recognise(made.root):
            with refused(re.escape(f"{table.name} does not exist")):
                read(made.root)
        (made.root / table).write_bytes(whole)


@EVERY
def test_reading_decodes_nothing_and_a_broken_sweep_is_named_when_it_is_read(copied, read, name):
    made = copied(name)
    for scan in made.scans:
        held = (made.root / scan).read_bytes()
        (made.root / scan).write_bytes(held[: len(held) // 2 + 1])
    # Readers open one photograph per camera if the tables of a set lack its size.
    for path in made.root.rglob("*.jpg"):
        if path != min(path.parent.iterdir()) and path.name != "000_1.jpg":
            path.write_bytes(b"never read")
    drive = read(made.root)
    assert len(drive.photographs) == len(made.photographs)
    assert len(drive.sweeps) == len(made.sweeps)
    for sweep in drive.sweeps if made.scans else ():
        with pytest.raises(UserError) as error:
            sweep.read()
        assert any(scan.name in error.value.message for scan in made.scans)


def first(**changes):
    return lambda rows: [{**rows[0], **changes}, *rows[1:]]


def every(**changes):
    return lambda rows: [{**row, **changes} for row in rows]


def given(content):
    return lambda held: content


MOUNT, FOCAL = f"{waymo.LENS}extrinsic.transform", f"{waymo.LENS}intrinsic.f_u"
LENSES, BOXES = waymo.file("camera_calibration"), waymo.file("lidar_box")
SIDE, TURN = (f"{waymo.BOX}box.{name}" for name in ("size.x", "heading"))
FRONT, CUBOIDS = pandaset.FRONT, pandaset.CUBOIDS / "01.pkl.gz"
NO_HEADING = {"position": dict.fromkeys("xyz", 0)}
BENT = {**NO_HEADING, "heading": dict.fromkeys("wxyz", 1)}
OXTS, SHOTS = (f"{kitti.DRIVE}/{part}" for part in ("oxts/data/0000000000.txt", "image_03"))
TRACKLETS = kitti.BOXES

ACROSS = [1.0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 1, 2, 3, 1]  # a transposed matrix
LAID = drivestudio.instance("a", [np.reshape(ACROSS, (4, 4))])
FLAT = drivestudio.instance("a", [np.eye(4)])
FLAT["frame_annotations"]["box_size"] = [[1, 0, 1]]


def item(old="", new=""):
    one = kitti.tracklet("Car", 0, [[1, 2, 3, 0]])
    return given(kitti.tracklets(one.replace(old, new) if old else one))


def tokens(table):
    return nuscenes.TABLES / f"{table}.json"


REFUSED = {
    "nuscenes": [
        (tokens("calibrated_sensor"), first(rotation=[2, 0, 0, 0]), "not a unit quaternion"),
        (tokens("calibrated_sensor"), first(camera_intrinsic=[[1, 2], [3]]), "9 finite numbers"),
        (tokens("calibrated_sensor"), first(camera_intrinsic=[[0] * 3] * 3), "a camera matrix"),
        (tokens("calibrated_sensor"), lambda rows: rows[1:], "no sensor calibrated CAM_FRONT"),
        (tokens("sensor"), lambda rows: rows[1:], "no sensor CAM_FRONT"),
        (tokens("sample"), first(timestamp="now"), "no valid 'timestamp'"),
        (tokens("sample"), lambda rows: [], "no sample of scene-0001"),
        (tokens("sample_data"), every(width=None), "the size of samples/CAM_FRONT"),
        (tokens("sample_annotation"), first(size=[1, 0, 1]), "has a side of 0 m"),
        (tokens("sample_annotation"), first(rotation="up"), "no valid 'rotation'"),
    ],
    "argoverse": [
        (argoverse.EXTRINSICS, every(qw=9.0), "sensor number 1 is not a unit quaternion"),
        (argoverse.EXTRINSICS, every(sensor_name="a"), "no pose of ring_front_center"),
        (argoverse.INTRINSICS, every(fx_px=0.0), "are not positive"),
        (argoverse.BOXES, every(width_m=0.0), "has a side of 0 m"),
        (argoverse.BOXES, every(timestamp_ns=0.5), "does not hold whole numbers"),
        (argoverse.BOXES, first(timestamp_ns=None), "without gaps"),
        (argoverse.POSES, lambda rows: [{"other": 1}], "no column"),
    ],
    "waymo": [
        (LENSES, every(**{MOUNT: [2.0] * 16}), "the pose of FRONT is not a rotation"),
        (LENSES, every(**{MOUNT: ACROSS}), "last row of the pose of FRONT is 1 2 3 1, not 0 0 0 1"),
        (LENSES, first(**{FOCAL: 0.0}), "the lens of FRONT"),
        (LENSES, every(**{FOCAL: "50"}), "does not hold numbers"),
        (LENSES, every(**{"key.camera_name": 8}), "has no camera SIDE_RIGHT"),
        (BOXES, first(**{SIDE: 0.0}), "positive sizes"),
        (BOXES, first(**{TURN: float("nan")}), "finite positions"),
        (waymo.file("lidar_pose"), lambda rows: [{"other": 1}], "has no column"),
    ],
    "pandaset": [
        (FRONT / "poses.json", lambda held: {}, "is not a list"),
        (FRONT / "poses.json", lambda held: [NO_HEADING], "the pose of frame 0 lacks"),
        (FRONT / "poses.json", lambda held: [BENT], "frame 0 is not a unit"),
        (FRONT / "intrinsics.json", lambda held: {"fx": 60}, "lacks"),
        (FRONT / "intrinsics.json", lambda held: held | {"fx": -50}, "which are not positive"),
        (FRONT / "timestamps.json", lambda held: ["now", "a", "b"], "entry 0 should be finite"),
        (CUBOIDS, lambda rows: [{"uuid": "a"}], "no column 'position.x'"),
        (CUBOIDS, every(**{"dimensions.x": 0.0}), "positive sizes"),
    ],
    "drivestudio": [
        ("ego_pose/000.txt", given("1 2 3"), "should be 16 finite"),
        ("ego_pose/000.txt", given(" ".join(map(str, ACROSS))), "this file is 1 2 3 1, not 0 0 0"),
        ("extrinsics/0.txt", given(drivestudio.text(np.diag([1, 1, 2, 1]))), "not a rotation"),
        ("extrinsics/0.txt", given(drivestudio.text(mounted(0.0))), "an upright camera of Waymo"),
        ("intrinsics/0.txt", given("0 1 2 3 4 5 6 7 8"), "two focal lengths"),
        (drivestudio.BOXES, lambda held: [], "is not a table of boxes"),
        (drivestudio.BOXES, lambda held: {"0": {"id": "a"}}, "is not a table of boxes"),
        (drivestudio.BOXES, lambda held: {"0": LAID}, "of the box of a is 1 2 3 1, not 0 0 0 1"),
        (drivestudio.BOXES, lambda held: {"0": FLAT}, "side of 0"),
    ],
    "kitti_tracking": [
        (tracking.CALIBRATION, given("R_rect 1 0 0 0 1 0 0 0 1\n"), "Tr_velo_cam should be 12"),
        (tracking.OXTS, given("49 8.4 110\n"), "should be 6 finite"),
        (tracking.OXTS, given(""), "holds no measurement"),
        (tracking.LABELS, given("0 0 Car 0 0\n"), "rotation in line 1 should be 8"),
        (tracking.LABELS, lambda held: held.replace("1.8", "0"), "side of 0"),
    ],
    "kitti_raw": [
        ("calib_imu_to_velo.txt", given("R: 1 0 0 0 1 0 0 0 2\nT: 0 0 0\n"), "not a rotation"),
        ("calib_imu_to_velo.txt", given("R: 1 0 0 0 1 0 0 0 -1\nT: 0 0 0\n"), "is a reflection"),
        ("calib_cam_to_cam.txt", given("R_rect_00: 1 0 0 0 1 0 0 0 1\n"), "P_rect_02 should be 12"),
        (f"{SHOTS}/timestamps.txt", given("yesterday\n"), "'yesterday' is not a date"),
        (OXTS, given("49 8.4 110"), "should be 6 finite"),
        (OXTS, given("90 0 0 0 0 0\n"), "no Mercator"),
        (TRACKLETS, lambda held: held[:80], "is not valid XML"),
        (TRACKLETS, item("<h>1.5</h>"), "l w h first_frame of a box"),
        (TRACKLETS, item("1.8", "0"), "side of 0"),
    ],
}
CASES = [(name, *case) for name, cases in REFUSED.items() for case in cases]


def rewrite(path, change):
    match path.suffix:
        case ".json":
            path.write_text(json.dumps(change(json.loads(path.read_text()))))
        case ".feather":
            rows = change(feather.read_table(path).to_pylist())
            feather.write_feather(pa.Table.from_pylist(rows), path)
        case ".parquet":
            rows = change(parquet.read_table(path).to_pylist())
            parquet.write_table(pa.Table.from_pylist(rows), path)
        case ".gz":
            pandaset.write_rows(path, change(pandaset.cuboids(1)))
        case _:
            path.write_text(change(path.read_text()))


@pytest.mark.parametrize(("name", "table", "change", "words"), CASES)
def test_values_that_make_no_sense_are_named(copied, read, name, table, change, words):
    root = copied(name).root
    rewrite(root / table, change)
    with refused(words, Path(table).name):
        read(root)
