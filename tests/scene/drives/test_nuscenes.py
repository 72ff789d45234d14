"""nuScenes: tables written by the published schema, and one real keyframe."""

import json
from pathlib import Path

import numpy as np
import pytest
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
from p2gs_jax.scene.drives.assemble import assemble
from p2gs_jax.scene.drives.nuscenes import is_nuscenes, read_nuscenes
from p2gs_jax.scene.pixels.store import ImageStore
from p2gs_jax.scene.rigid import inverse

START = 1532402927647951
CAMERAS = {"CAM_FRONT": 0.0, "CAM_BACK_LEFT": 1.9}
SCANNER = matrix(Rotation.from_euler("z", -np.pi / 2), [0.9, 0, 1.8])
K = [[50.0, 0, 31.5], [0, 50, 23.5], [0, 0, 1]]
LAG = {"CAM_FRONT": -0.035, "CAM_BACK_LEFT": -0.001}
CFG = DataConfig()


def silent(message):
    pass


def read(root, cfg=CFG):
    return read_nuscenes(root, cfg, silent)


def sensors() -> tuple[list, list]:
    kinds, calibrated = [], []
    for channel, azimuth in CAMERAS.items():
        kinds.append({"token": channel, "channel": channel, "modality": "camera"})
        calibrated.append(placed(channel, mounted(azimuth), K))
    kinds.append({"token": "LIDAR_TOP", "channel": "LIDAR_TOP", "modality": "lidar"})
    kinds.append({"token": "RADAR", "channel": "RADAR_FRONT", "modality": "radar"})
    return kinds, [*calibrated, placed("LIDAR_TOP", SCANNER, []), placed("RADAR", np.eye(4), [])]


def placed(channel, pose, K) -> dict:
    return {
        "token": f"calibrated {channel}",
        "sensor_token": channel,
        "translation": pose[:3, 3].tolist(),
        "rotation": wxyz(pose),
        "camera_intrinsic": K,
    }


def recorded(root, scene, sample, channel, seconds, key) -> tuple[dict, dict]:
    """Write a file, and return its rows of sample_data and ego_pose."""
    stamp = START + round(seconds * 1e6)
    ending = "jpg" if channel.startswith("CAM") else "pcd.bin"
    name = f"{'samples' if key else 'sweeps'}/{channel}/{scene}__{channel}__{stamp}.{ending}"
    path = root / name
    if channel == "LIDAR_TOP":
        path.parent.mkdir(parents=True, exist_ok=True)
        local = applied(inverse(car_at(seconds) @ SCANNER), landmarks())
        np.column_stack([local, np.zeros((len(local), 2))]).astype("<f4").tofile(path)
    else:
        write_jpeg(path)
    token = f"{scene} {channel} {stamp}"
    ego = car_at(seconds)
    row = {
        "token": token,
        "sample_token": sample,
        "ego_pose_token": token,
        "calibrated_sensor_token": f"calibrated {channel}",
        "timestamp": stamp,
        "filename": name,
        "is_key_frame": key,
        "width": WIDTH if channel.startswith("CAM") else 0,
        "height": HEIGHT if channel.startswith("CAM") else 0,
    }
    pose = {
        "token": token,
        "timestamp": stamp,
        "translation": ego[:3, 3].tolist(),
        "rotation": wxyz(ego),
    }
    return row, pose


def boxed(scene, sample, instance, pose, attributes) -> dict:
    return {
        "token": f"{sample} {instance}",
        "sample_token": sample,
        "instance_token": f"{scene} {instance}",
        "attribute_tokens": attributes,
        "translation": pose[:3, 3].tolist(),
        "size": [1.8, 4.2, 1.5],
        "rotation": wxyz(pose),
    }


# Ahead of the scanner when the first turn ends.
AHEAD = car_at(0.0) @ SCANNER @ matrix(Rotation.identity(), [0, 12, 0])


def write_set(root: Path, scenes=("scene-0001",), count=3, version="v1.0-mini") -> Path:
    names = "scene sample sample_data ego_pose sample_annotation instance category attribute"
    tables: dict[str, list] = {name: [] for name in names.split()}
    tables["sensor"], tables["calibrated_sensor"] = sensors()
    tables["category"].append({"token": "car", "name": "vehicle.car"})
    tables["attribute"] += [
        {"token": "moving", "name": "vehicle.moving"},
        {"token": "parked", "name": "vehicle.parked"},
        {"token": "rider", "name": "cycle.with_rider"},
    ]
    for scene in scenes:
        tables["scene"].append({"token": f"scene {scene}", "name": scene, "nbr_samples": count})
        for moment in reversed(range(count)):
            sample = f"{scene} sample {moment}"
            seconds = 0.5 * moment
            tables["sample"].append(
                {
                    "token": sample,
                    "scene_token": f"scene {scene}",
                    "timestamp": START + round(seconds * 1e6),
                }
            )
            data = [(c, seconds + LAG[c], True) for c in CAMERAS]
            data += [("LIDAR_TOP", seconds, True), ("LIDAR_TOP", seconds - 0.05, False)]
            data += [("RADAR", seconds, True), ("CAM_FRONT", seconds - 0.1, False)]
            for channel, at, key in data:
                row, pose = recorded(root, scene, sample, channel, at, key)
                tables["sample_data"].append(row)
                tables["ego_pose"].append(pose)
            driven = matrix(Rotation.identity(), [2.0 * moment, 0, 0]) @ AHEAD
            tables["sample_annotation"] += [
                boxed(scene, sample, "driving", driven, ["moving"] if moment else ["parked"]),
                boxed(scene, sample, "parked", AHEAD, ["parked"]),
                boxed(scene, sample, "cycle", driven, ["rider"]),
            ]
        for instance in ("driving", "parked", "cycle"):
            tables["instance"].append({"token": f"{scene} {instance}", "category_token": "car"})
    (root / version).mkdir(parents=True, exist_ok=True)
    for name, rows in tables.items():
        (root / version / f"{name}.json").write_text(json.dumps(rows, indent=1))
    return root


@pytest.fixture
def made(tmp_path):
    return write_set(tmp_path / "set")


def edit(root, table, change):
    path = root / "v1.0-mini" / f"{table}.json"
    rows = json.loads(path.read_text())
    path.write_text(json.dumps(change(rows)))


def test_each_photograph_has_its_own_time_and_pose(made):
    assert is_nuscenes(made)
    assert not is_nuscenes(made / "samples")
    drive = read(made)
    assert [c.name for c in drive.cameras] == ["CAM_BACK_LEFT", "CAM_FRONT"]
    np.testing.assert_array_equal(drive.cameras[0].K[:2, 2], [32, 24])
    assert (drive.cameras[0].width, drive.cameras[0].height) == (WIDTH, HEIGHT)
    assert len(drive.photographs) == 6
    for photograph in drive.photographs:
        seconds = 0.5 * photograph.frame + LAG[photograph.camera]
        assert photograph.time == pytest.approx(seconds, abs=1e-6)
        expected = car_at(seconds) @ mounted(CAMERAS[photograph.camera])
        np.testing.assert_allclose(photograph.pose, expected, atol=1e-4)
        assert photograph.path.is_file()
    assert drive.notes == ()


def test_sweeps_between_keyframes_count_and_points_have_their_own_time(made):
    drive = read(made)
    assert [s.frame for s in drive.sweeps] == [0, 0, 1, 1, 2, 2]
    for sweep in drive.sweeps:
        points, times = sweep.read()
        np.testing.assert_allclose(points, landmarks(), atol=1e-3)
        assert np.all(np.diff(times) > 0)
        assert times[0] == pytest.approx(sweep.time - 0.05)
        assert times[-1] < sweep.time


def test_boxes_become_tracks_of_when_the_scanner_passed(made):
    things = {t.name.split()[1]: t for t in read(made).objects}
    assert {n: t.moving for n, t in things.items()} == {
        "driving": True,
        "parked": False,
        "cycle": True,
    }
    driving = things["driving"]
    assert (driving.label, driving.size) == ("vehicle.car", (4.2, 1.8, 1.5))
    # The turn begins at the scanner's left; ahead is a quarter of it later.
    assert driving.times[0] == pytest.approx(-0.75 * 0.05, abs=1e-6)
    np.testing.assert_allclose(driving.poses[0], AHEAD, atol=1e-6)
    np.testing.assert_allclose(driving.poses[2, :3, 3] - AHEAD[:3, 3], [4, 0, 0], atol=1e-6)


def test_a_drive_of_several_is_named(tmp_path):
    root = write_set(tmp_path, ("scene-0001", "scene-0002"), 2)
    with pytest.raises(UserError, match="holds 2 drives: scene-0001, scene-0002"):
        read(root)
    drive = read(root, DataConfig(drive="scene-0002"))
    assert len(drive.photographs) == 4
    assert all("scene-0002" in p.path.name for p in drive.photographs)
    # Of the others only tables are there.
    for path in root.glob("samples/CAM_*/scene-0001*"):
        path.unlink()
    assert all("scene-0002" in p.path.name for p in read(root).photographs)


def test_one_of_several_versions_serves(tmp_path):
    write_set(tmp_path, count=1)
    cut(tmp_path / "v1.0-mini" / "sample_data.json")
    write_set(tmp_path, count=1, version="v1.0-a")
    assert len(read(tmp_path).photographs) == 2


def test_one_frame_is_enough(tmp_path):
    drive = read(write_set(tmp_path, count=1))
    assert len(drive.photographs) == 2
    scene = assemble(drive, CFG)
    assert len(scene.views) == 2
    assert scene.lidar is not None


def test_what_is_missing_is_counted(made):
    edit(made, "ego_pose", lambda rows: [r for r in rows if "CAM_FRONT" not in r["token"]])
    edit(made, "scene", lambda rows: [{**rows[0], "nbr_samples": 39}])
    edit(
        made,
        "sample_annotation",
        lambda rows: [{**r, "instance_token": ""} if "cycle" in r["token"] else r for r in rows],
    )
    next(iter((made / "samples" / "LIDAR_TOP").iterdir())).unlink()
    next(iter((made / "sweeps" / "LIDAR_TOP").iterdir())).unlink()
    drive = read(made)
    assert len(drive.photographs) == 3
    assert len(drive.sweeps) == 4
    assert len(drive.objects) == 2
    assert drive.notes == (
        "scene.json counts 39 samples, sample.json holds 3.",
        "3 boxes in sample_annotation.json belong to no instance: they are left out.",
        "3 photographs have no pose in ego_pose.json: they are left out.",
        "1 LiDAR sweeps of the keyframes are missing, or have no pose.",
    )


def test_without_boxes_nothing_is_known_to_move(made):
    (made / "v1.0-mini" / "sample_annotation.json").unlink()
    assert any("what moves is not known" in note for note in read(made).notes)
    (made / "v1.0-mini" / "sample_annotation.json").write_text("[]")
    assert any("holds no box" in note for note in read(made).notes)


def test_missing_photographs_are_complained_about(made):
    next(iter((made / "samples" / "CAM_FRONT").iterdir())).unlink()
    with pytest.raises(UserError, match="CAM_FRONT/scene-0001__CAM_FRONT"):
        assemble(read(made), CFG)
    scene = assemble(read(made), DataConfig(allow_missing=True))
    assert len(scene.views) == 5


@pytest.mark.parametrize(
    "table",
    [
        "scene",
        "sample",
        "sample_data",
        "ego_pose",
        "calibrated_sensor",
        "sensor",
        "sample_annotation",
    ],
)
def test_broken_tables_are_named(made, table):
    path = made / "v1.0-mini" / f"{table}.json"
    whole = path.read_text()
    cut(path)
    with pytest.raises(UserError, match=f"{table}.json is no valid table"):
        read(made)
    for wrong in ("{}", "[1]", "", "\udcff", whole.replace('"', "'")):
        path.write_text(wrong, errors="surrogateescape")
        with pytest.raises(UserError, match=f"{table}.json"):
            read(made)
    if table not in ("sample_data", "sample_annotation"):
        path.unlink()
        with pytest.raises(UserError, match=f"{table}.json is missing"):
            read(made)


def first(**changes):
    return lambda rows: [{**rows[0], **changes}, *rows[1:]]


@pytest.mark.parametrize(
    ("table", "change", "words"),
    [
        ("calibrated_sensor", first(rotation=[2, 0, 0, 0]), "no unit quaternion"),
        ("calibrated_sensor", first(rotation=[1, 0, 0]), "should be 4 numbers, not 3"),
        ("calibrated_sensor", first(translation=["x", 0, 0]), "finite numbers"),
        ("calibrated_sensor", first(camera_intrinsic=[[1, 2], [3]]), "9 numbers"),
        ("calibrated_sensor", first(camera_intrinsic=[[0] * 3] * 3), "no camera matrix"),
        ("calibrated_sensor", lambda rows: rows[1:], "no sensor calibrated CAM_FRONT"),
        ("sensor", lambda rows: rows[1:], "no sensor CAM_FRONT"),
        ("sample", first(timestamp="now"), "no valid 'timestamp'"),
        ("sample", lambda rows: [], "no sample of scene-0001"),
        (
            "sample_data",
            lambda rows: [{**r, "width": None} for r in rows],
            "the size of samples/CAM_FRONT",
        ),
        ("ego_pose", first(rotation=[float("nan")] * 4), "finite numbers"),
        ("sample_annotation", first(size=[1, 0, 1]), "has no size"),
        ("sample_annotation", first(rotation="up"), "no valid 'rotation'"),
    ],
)
def test_senseless_rows_are_named(made, table, change, words):
    edit(made, table, change)
    with pytest.raises(UserError, match=words) as error:
        read(made)
    assert f"{table}.json" in error.value.message


@pytest.mark.parametrize("name", ["/etc/passwd", "../elsewhere.jpg", "samples/../../x.jpg"])
@pytest.mark.parametrize("modality", ["CAM_FRONT", "LIDAR_TOP"])
def test_files_outside_the_set_are_refused(made, name, modality):
    def moved(rows):
        row = next(r for r in rows if f"/{modality}/" in r["filename"] and r["is_key_frame"])
        row["filename"] = name
        return rows

    edit(made, "sample_data", moved)
    with pytest.raises(UserError, match=r"sample_data\.json names .* outside of"):
        read(made)


def test_a_sweep_that_is_cut_off_is_named_when_it_is_read(made):
    for path in (made / "sweeps" / "LIDAR_TOP").iterdir():
        path.write_bytes(path.read_bytes()[:-3])
    with pytest.raises(UserError, match=r"sweeps/LIDAR_TOP/.* is no LiDAR sweep"):
        read(made).sweeps[0].read()


# ------------------------------------------------------------------ the real keyframe


@pytest.fixture
def real(shared_data):
    return shared_data("nuscenes_one_frame")


def test_real_poses_are_those_of_the_flat_calibration(real):
    drive = read(real)
    flat = json.loads((real / "calib_flat.json").read_text())
    assert len(drive.photographs) == 6
    assert drive.notes[0] == "scene.json counts 39 samples, sample.json holds 1."
    for photograph in drive.photographs:
        known = flat[photograph.camera]
        pose = np.array(known["ego_to_global"]) @ np.array(known["sensor_to_ego"])
        np.testing.assert_allclose(photograph.pose, pose, atol=1e-6)
        seconds = (known["timestamp_us"] - flat["LIDAR_TOP"]["timestamp_us"]) * 1e-6
        assert photograph.time == pytest.approx(seconds, abs=1e-9)
        assert photograph.path.is_file()


def test_real_laser_points_land_in_the_images_when_those_were_taken(real):
    drive = read(real)
    points, times = drive.sweeps[0].read()
    assert len(points) == 34688
    cameras = {c.name: c for c in drive.cameras}
    for photograph in drive.photographs:
        camera, to_camera = cameras[photograph.camera], inverse(photograph.pose)
        local = applied(to_camera, points)
        front = local[:, 2] > 1
        image = local[front] @ camera.K.T
        xy = image[:, :2] / image[:, 2:]
        inside = ((xy >= 0) & (xy < [camera.width, camera.height])).all(1)
        assert 3000 < inside.sum() < 4900
        # Cameras are triggered as the scanner passes the middle of their images.
        middle = np.abs(xy[:, 0] / camera.width - 0.5) < 0.05
        passed = np.median(times[front][inside & middle])
        assert photograph.time - passed == pytest.approx(0.002, abs=0.0006)


def test_real_pictures_have_edges_where_depth_jumps(real):
    drive = read(real)
    scene = assemble(drive, CFG)
    assert len(scene.views) == 6
    assert len(scene.points) > 10_000
    points = drive.sweeps[0].read().points - scene.origin
    store = ImageStore(scene.views, CFG)
    ratios = []
    for index, view in enumerate(scene.views):
        local = applied(view.viewmat.astype(np.float64), points)
        with np.errstate(divide="ignore"):
            xy = (local @ view.K.T)[:, :2] / local[:, 2:]
        # Neighbours of one beam follow each other 32 apart.
        near = np.stack([xy[:-32], xy[32:]], 1)
        z = np.stack([local[:-32, 2], local[32:, 2]], 1)
        inside = ((near >= 0) & (near < [view.width - 1, view.height])).all((1, 2))
        gap = np.abs(near[:, 1] - near[:, 0])
        use = inside & (z > 1).all(1) & (gap < [25, 8]).all(1)
        gradient = np.abs(np.diff(store.get(index, 1)[0].mean(2), axis=1))
        strongest = np.array(
            [
                gradient[int(row), int(min(ends)) : int(max(ends)) + 1].max()
                for ends, row in zip(near[use, :, 0], near[use, 0, 1], strict=True)
            ]
        )
        jumps = z[use].max(1) > 1.2 * z[use].min(1)
        ratios.append(strongest[jumps].mean() / strongest[~jumps].mean())
    # 2.2; with the points 4 pixels to either side below 2.
    assert np.median(ratios) > 2.1
