"""PandaSet: the real sequence, and made ones with faults."""

import gzip
import json
import pickle
import shutil
import time

import cv2
import numpy as np
import pandas as pd
import pytest
from scene.drives import made_kitti as made
from scipy.spatial.transform import Rotation

from p2gs_jax.config import DataConfig
from p2gs_jax.errors import UserError
from p2gs_jax.scene import load_scene
from p2gs_jax.scene.drives import read_drive
from p2gs_jax.scene.drives.lidar import owners
from p2gs_jax.scene.drives.pandaset import is_pandaset, read_pandaset
from p2gs_jax.scene.drives.tables import (
    read_pickled,
)
from p2gs_jax.scene.rigid import (
    interpolated,
)

CFG = DataConfig()
BEGIN = 1557539956.5
CAMERAS = ("front_camera", "left_camera")
FRAMES = 3


def read(root, cfg=CFG):
    return read_pandaset(root, cfg, lambda message: None)


def pose(position, rotation=(1.0, 0, 0, 0)):
    return {
        "position": dict(zip("xyz", map(float, position), strict=True)),
        "heading": dict(zip("wxyz", map(float, rotation), strict=True)),
    }


def cuboid(uuid, position, *, yaw=0.0, stationary=False, sensor=-1, sibling="-", label="Car"):
    return {
        "uuid": uuid,
        "label": label,
        "yaw": yaw,
        "stationary": stationary,
        **{f"position.{a}": float(v) for a, v in zip("xyz", position, strict=True)},
        **{f"dimensions.{a}": v for a, v in zip("xyz", (1.8, 4.2, 1.5), strict=True)},
        "cuboids.sibling_id": sibling,
        "cuboids.sensor_id": sensor,
    }


SLOW, FAST = "11111111-aaaa", "22222222-bbbb-cccc"
TWIN = "33333333-dddd"


def cuboids(frame):
    """Return a parked car, one that drives ahead at 10 m/s along y, and that one's second box."""
    ahead = (0.0, 10.0 + frame, 0.7)
    return [
        cuboid(SLOW, (8.0, 0.0, 0.7), yaw=np.pi / 2, stationary=True),
        cuboid(FAST, ahead, sensor=0),
        # Of this sibling's name the end is missing, as in the real set.
        cuboid(TWIN, (0.0, 10.7 + frame, 0.7), sensor=1, sibling=FAST[:-4]),
    ]


def write_table(path, table):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(gzip.compress(pickle.dumps(table)))


@pytest.fixture
def root(tmp_path):
    return write_sequence(tmp_path / "002")


def write_sequence(folder):
    """Write a sequence: a car that stands at the origin and looks along y."""
    looking = {"front_camera": np.eye(3), "left_camera": Rotation.from_euler("z", 90, True)}
    looking["front_camera"] = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    looking["left_camera"] = looking["left_camera"].as_matrix() @ looking["front_camera"]
    late = {"front_camera": -0.05, "left_camera": -0.075}
    for camera in CAMERAS:
        place = folder / "camera" / camera
        place.mkdir(parents=True)
        for k in range(FRAMES):
            assert cv2.imwrite(str(place / f"{k:02d}.jpg"), np.full((48, 64, 3), 99, np.uint8))
        (place / "intrinsics.json").write_text('{"fx": 60, "fy": 61, "cx": 31.5, "cy": 23.5}')
        quaternion = np.roll(Rotation.from_matrix(looking[camera]).as_quat(), 1)
        poses = [pose((0, 0, 1.6), quaternion)] * FRAMES
        (place / "poses.json").write_text(json.dumps(poses))
        times = [BEGIN + 0.1 * k + late[camera] for k in range(FRAMES)]
        (place / "timestamps.json").write_text(json.dumps(times))
    lidar = folder / "lidar"
    rng = np.random.default_rng(0)
    for k in range(FRAMES):
        points = rng.uniform([-9, 4, 0], [9, 30, 3], (500, 3))
        table = pd.DataFrame(points, columns=list("xyz")).assign(
            i=1.0, t=BEGIN + 0.1 * k - 0.05, d=np.arange(500) % 2
        )
        write_table(lidar / f"{k:02d}.pkl.gz", table)
        rows = pd.DataFrame(cuboids(k))
        write_table(folder / f"annotations/cuboids/{k:02d}.pkl.gz", rows)
    (lidar / "poses.json").write_text(json.dumps([pose((0, 0, 0))] * FRAMES))
    ends = [BEGIN + 0.1 * k for k in range(FRAMES)]
    (lidar / "timestamps.json").write_text(json.dumps(ends))
    return folder


def test_a_made_sequence(root):
    recording = read(root)
    assert [c.name for c in recording.cameras] == list(CAMERAS)
    assert recording.cameras[0].K[:2, 2].tolist() == [32.0, 24.0]
    assert len(recording.photographs) == 6
    ahead = next(p for p in recording.photographs if p.camera == "left_camera")
    np.testing.assert_allclose(ahead.pose[:3, 2], [-1, 0, 0], atol=1e-12)
    assert recording.notes == ()
    slow, fast = recording.objects
    assert (slow.name, slow.moving, slow.size) == (SLOW, False, (4.2, 1.8, 1.5))
    # A yaw of 0 looks along y, a quarter turn counterclockwise against x.
    np.testing.assert_allclose(fast.poses[0, :3, 0], [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(slow.poses[0, :3, 0], [-1, 0, 0], atol=1e-12)
    assert fast.moving
    # The scanner looked ahead in the middle of its turn, to the right after three quarters.
    np.testing.assert_allclose(fast.times, BEGIN + 0.1 * np.arange(3) - 0.05, atol=1e-6)
    np.testing.assert_allclose(slow.times, BEGIN + 0.1 * np.arange(3) - 0.025, atol=1e-6)


def test_a_made_sequence_becomes_a_scene(root):
    scene = load_scene(root, DataConfig(cameras=("front",)))
    assert scene.format == "pandaset"
    assert [v.name for v in scene.views] == [f"front_camera/{k:02d}.jpg" for k in range(FRAMES)]
    assert scene.lidar is not None
    assert 0 < (scene.lidar.objects >= 0).mean() < 0.3
    assert len(scene.points) > 100


def test_reading_is_fast_and_decodes_nothing(root):
    """Six cameras and eighty frames are read within five seconds, also on a busy machine."""
    for k in range(FRAMES, 80):
        many = pd.DataFrame([cuboid(f"{k % 7}-{n}", (n, 5, 0)) for n in range(120)])
        write_table(root / f"annotations/cuboids/{k:02d}.pkl.gz", many)
        (root / f"lidar/{k:02d}.pkl.gz").write_bytes(b"never read")
    for path in [*root.glob("camera/*/*.json"), *root.glob("lidar/*.json")]:
        held = json.loads(path.read_text())
        if isinstance(held, list):
            long = held + held[-1:] * 77
            if path.name == "timestamps.json":
                long = [held[0] + 0.1 * k for k in range(80)]
            path.write_text(json.dumps(long))
    for name in ("right", "back", "front_left", "front_right"):
        shutil.copytree(root / "camera/left_camera", root / f"camera/{name}_camera")
    for camera in root.glob("camera/*"):
        for k in range(FRAMES, 80):
            (camera / f"{k:02d}.jpg").write_bytes(b"never read")
    begin = time.process_time()
    recording = read(root)
    assert time.process_time() - begin < 5
    assert (len(recording.photographs), len(recording.sweeps)) == (480, 80)


def test_several_sequences_want_one_named(root):
    shutil.copytree(root, root.with_name("003"))
    assert is_pandaset(root.parent)
    with pytest.raises(UserError, match="holds 2 drives"):
        read(root.parent)
    assert read(root.parent, DataConfig(drive="003")).root == root.with_name("003")


def test_one_frame(root):
    for path in [*root.glob("camera/*/*.json"), *root.glob("lidar/*.json")]:
        held = json.loads(path.read_text())
        if isinstance(held, list):
            path.write_text(json.dumps(held[:1]))
    for path in [*root.rglob("01.*"), *root.rglob("02.*")]:
        path.unlink()
    recording = read(root)
    assert {p.frame for p in recording.photographs} == {0}
    assert [len(thing.times) for thing in recording.objects] == [1, 1]
    assert not any(thing.moving for thing in recording.objects)


def test_what_is_missing_is_counted(root):
    for path in root.glob("camera/left_camera/*.jpg"):
        path.unlink()
    poses = json.loads((root / "camera/front_camera/poses.json").read_text())
    poses[1] = None
    (root / "camera/front_camera/poses.json").write_text(json.dumps(poses))
    (root / "lidar/01.pkl.gz").unlink()
    (root / "annotations/cuboids/02.pkl.gz").unlink()
    rows = pd.DataFrame([*cuboids(0), cuboid(None, (1, 2, 3)), cuboid("x", (1, 9, 1), sensor=1)])
    write_table(root / "annotations/cuboids/00.pkl.gz", rows)
    recording = read(root)
    notes = "\n".join(recording.notes)
    assert "left_camera has no photographs" in notes
    assert "front_camera: 1 photographs have no pose or time" in notes
    assert "1 of 3 LiDAR sweeps are missing" in notes
    assert "1 of 3 frames have no boxes" in notes
    assert "1 boxes belong to no track" in notes
    assert "1 moving things have boxes of the forward scanner only" in notes
    assert [p.frame for p in recording.photographs] == [0, 2]
    assert {thing.name for thing in recording.objects} == {SLOW, FAST, "x"}


def test_without_laser_points_and_boxes(root):
    shutil.rmtree(root / "annotations")
    shutil.rmtree(root / "lidar")
    recording = read(root)
    assert (recording.sweeps, recording.objects) == ((), ())
    assert any("no boxes" in note for note in recording.notes)


def put(path, text):
    (path).write_text(text)


FRONT = "camera/front_camera"
BROKEN = {
    "cut poses": (lambda r: put(r / FRONT / "poses.json", '[{"posi'), r"poses\.json is no valid"),
    "no list": (lambda r: put(r / FRONT / "poses.json", "{}"), r"poses\.json holds no list"),
    "no poses": (lambda r: (r / FRONT / "poses.json").unlink(), r"poses\.json is missing"),
    "no heading": (
        lambda r: put(r / FRONT / "poses.json", '[{"position": {"x": 0, "y": 0, "z": 0}}]'),
        "the pose of frame 0 lacks",
    ),
    "no rotation": (
        lambda r: put(r / FRONT / "poses.json", json.dumps([pose((0, 0, 0), (1, 1, 0, 0))])),
        r"poses\.json: the pose of frame 0 has a rotation that is no unit",
    ),
    "no focal length": (
        lambda r: put(r / FRONT / "intrinsics.json", '{"fx": 60}'),
        r"intrinsics\.json lacks",
    ),
    "words": (
        lambda r: put(r / FRONT / "timestamps.json", '["now", "then", "soon"]'),
        r"timestamps\.json: entry 0 should be finite",
    ),
    "no sweep times": (
        lambda r: (r / "lidar/timestamps.json").unlink(),
        r"timestamps\.json is missing",
    ),
    "no sweep poses": (lambda r: (r / "lidar/poses.json").unlink(), r"poses\.json is missing"),
    "cut boxes": (
        lambda r: (r / "annotations/cuboids/01.pkl.gz").write_bytes(b"\x1f\x8b"),
        r"01\.pkl\.gz holds no table",
    ),
    "no label": (
        lambda r: write_table(
            r / "annotations/cuboids/01.pkl.gz", pd.DataFrame(cuboids(1)).drop(columns="label")
        ),
        r"01\.pkl\.gz: its table has no column 'label'",
    ),
    "words for sizes": (
        lambda r: write_table(
            r / "annotations/cuboids/01.pkl.gz",
            pd.DataFrame(cuboids(1)).assign(**{"dimensions.x": "wide"}),
        ),
        "'dimensions.x' holds no numbers",
    ),
    "no size": (
        lambda r: write_table(
            r / "annotations/cuboids/01.pkl.gz",
            pd.DataFrame(cuboids(1)).assign(**{"dimensions.x": 0.0}),
        ),
        "positive sizes",
    ),
}


@pytest.mark.parametrize("case", BROKEN, ids=str)
def test_broken_sequences_name_the_file(root, case):
    change, message = BROKEN[case]
    change(root)
    with pytest.raises(UserError, match=message):
        read(root)


def test_a_cut_sweep_is_complained_about_when_it_is_read(root):
    path = root / "lidar" / "00.pkl.gz"
    path.write_bytes(path.read_bytes()[:500])
    sweep = read(root).sweeps[0]
    with pytest.raises(UserError, match=r"00\.pkl\.gz holds no table"):
        sweep.read()


@pytest.fixture
def real(shared_data):
    recording = read_drive(shared_data("pandaset_002"), CFG)
    assert recording is not None
    return recording


def test_the_real_sequence(real):
    assert real.format == "pandaset"
    assert len(real.cameras) == 6
    assert {(c.width, c.height) for c in real.cameras} == {(1920, 1080)}
    assert len(real.photographs) == 180
    assert [s.frame for s in real.sweeps] == [0, 10, 20, 29]
    assert (len(real.objects), sum(thing.moving for thing in real.objects)) == (94, 32)
    assert real.notes == ("26 of 30 LiDAR sweeps are missing.",)
    # Cars are longer than wide, and drive about where they look (one turns).
    for thing in real.objects:
        if thing.label == "Car":
            assert thing.size[0] > thing.size[1]
        way = thing.poses[-1, :3, 3] - thing.poses[0, :3, 3]
        if thing.label == "Car" and np.linalg.norm(way) > 3:
            assert way @ thing.poses[0, :3, 0] > 0.8 * np.linalg.norm(way)


def test_the_scanner_passed_boxes_when_it_is_said_to(real):
    """Points of the spinning scanner carry times; those in a box are of the box's time."""
    apart = []
    for sweep in real.sweeps:
        table = read_pickled(real.root / f"lidar/{sweep.frame:02d}.pkl.gz")
        spinning = table["d"] == 0
        points = np.stack([table[a][spinning] for a in "xyz"], 1)
        times = table["t"][spinning]
        row = owners(points, times, real.objects)
        for k in set(row[row >= 0]):
            nearest = np.abs(real.objects[k].times - np.median(times[row == k])).min()
            apart.append(nearest)
    assert len(apart) > 50
    assert np.median(apart) < 0.002
    assert np.quantile(apart, 0.9) < 0.006


def test_boxes_are_where_the_forward_scanner_saw_them_at_another_time(real):
    """Second boxes are left out; they are of other times, to which tracks are interpolated."""
    things = {thing.name: thing for thing in real.objects}
    ours, unmoved = [], []
    for sweep in real.sweeps:
        points = read_pickled(real.root / f"lidar/{sweep.frame:02d}.pkl.gz")
        boxes = read_pickled(real.root / f"annotations/cuboids/{sweep.frame:02d}.pkl.gz")
        xyz, forward = np.stack([points[a] for a in "xyz"], 1), points["d"] == 1
        for k in np.flatnonzero(boxes["cuboids.sensor_id"] == 1):
            sibling = boxes["cuboids.sibling_id"][k]
            thing = next((t for name, t in things.items() if name.startswith(sibling)), None)
            place = np.array([boxes[f"position.{a}"][k] for a in "xyz"])
            near = forward & (np.linalg.norm(xyz - place, axis=1) < 2)
            if thing is None or near.sum() < 10:
                continue
            way = thing.poses[-1, :3, 3] - thing.poses[0, :3, 3]
            if np.linalg.norm(way) / np.ptp(thing.times) < 4:
                continue
            there, _ = interpolated(thing.times, thing.poses, [np.median(points["t"][near])])
            frame = np.argmin(np.abs(thing.times - (sweep.time - 0.05)))
            along = thing.poses[0, :3, 0]
            ours.append(abs((there[0, :3, 3] - place) @ along))
            unmoved.append(abs((thing.poses[frame, :3, 3] - place) @ along))
    assert len(ours) > 20
    assert np.median(ours) < 0.12
    assert np.median(unmoved) > 2 * np.median(ours)


def test_damaged_files_end_in_a_recording_or_a_complaint(root):
    assert made.read_damaged(root, lambda: read_drive(root, CFG)) > 10
