"""From a recording to a scene: what is chosen, what is counted, what is said."""

import dataclasses
import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from p2gs_jax.config import DataConfig
from p2gs_jax.errors import UserError
from p2gs_jax.scene.drives.assemble import assemble
from p2gs_jax.scene.drives.lidar import owners, seeds
from p2gs_jax.scene.drives.recording import (
    Photograph,
    Recording,
    RigCamera,
    Sweep,
    SweepPoints,
    chosen_cameras,
    chosen_frames,
    short_name,
)
from p2gs_jax.scene.rigid import (
    from_quaternion,
    interpolated,
    inverse,
    rigid,
)
from p2gs_jax.scene.split import assign_split
from p2gs_jax.types import Lidar, TrackedObject

CAMERAS, FRAMES, WIDTH, HEIGHT = ("CAM_FRONT", "CAM_BACK"), 6, 8, 6
K = np.array([[6.0, 0, 4], [0, 6, 3], [0, 0, 1]])
FAR = np.array([5000.0, -300.0, 20.0])
RNG = np.random.default_rng(0)


def picture() -> Image.Image:
    return Image.fromarray(RNG.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8))


def pose(frame: int, turned: float) -> np.ndarray:
    out = np.eye(4)
    out[0, 0] = out[2, 2] = np.cos(turned)
    out[0, 2], out[2, 0] = np.sin(turned), -np.sin(turned)
    out[:3, 3] = FAR + np.array([0, 0, frame])
    return out


def car(moving: bool = True, name: str = "a") -> TrackedObject:
    times = np.arange(FRAMES) / 10
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    poses[:, :3, 3] = FAR + np.array([2, 0, 0]) + np.arange(FRAMES)[:, None] * [0, 1.0, 0]
    return TrackedObject(name, "Car", (4.0, 2.0, 1.5), times, poses, moving)


def scan(frame: int) -> Sweep:
    """Return a sweep: 50 points on the car as it is then, 200 about it."""

    def read() -> SweepPoints:
        on = car().poses[frame, :3, 3] + RNG.uniform(-0.7, 0.7, (50, 3))
        around = FAR + RNG.uniform(20, 30, (200, 3))
        points = np.concatenate([on, around, [[np.nan] * 3]])
        return SweepPoints(points, np.full(len(points), frame / 10))

    return Sweep(frame, frame / 10, read)


@pytest.fixture
def drive(tmp_path) -> Recording:
    photographs = []
    for k, camera in enumerate(CAMERAS):
        (tmp_path / camera).mkdir()
        for frame in range(FRAMES):
            path = tmp_path / camera / f"{frame:02d}.png"
            picture().save(path)
            at = frame / 10 + 0.01 * k
            photographs.append(Photograph(camera, frame, at, path, pose(frame, np.pi * k)))
    cameras = tuple(RigCamera(name, K, WIDTH, HEIGHT) for name in CAMERAS)
    sweeps = tuple(scan(frame) for frame in range(FRAMES))
    things = (car(), car(moving=False, name="b"))
    return Recording(tmp_path, "made", cameras, tuple(photographs), sweeps, things)


PLAIN = DataConfig(own_car=False)


def test_a_drive_becomes_views_with_frames_and_times_near_the_origin(drive):
    scene = assemble(drive, PLAIN)
    assert [v.name for v in scene.views[:2]] == ["CAM_BACK/00.png", "CAM_BACK/01.png"]
    assert {v.frame for v in scene.views} == set(range(FRAMES))
    front = next(v for v in scene.views if v.camera == "CAM_FRONT" and v.frame == 3)
    assert front.time == pytest.approx(0.3)
    assert np.abs(scene.origin - FAR).max() <= 3.5
    centre = -front.viewmat[:3, :3].T @ front.viewmat[:3, 3]
    np.testing.assert_allclose(centre + scene.origin, FAR + np.array([0, 0, 3]), atol=1e-4)
    moved = scene.objects[0].poses[2, :3, 3] + scene.origin
    np.testing.assert_allclose(moved, FAR + np.array([2, 2, 0]), atol=1e-9)


@pytest.mark.parametrize("name", ["../../CAM", "/CAM", "CAM/a", "..", "", "CAM\\a"])
def test_a_camera_whose_name_is_a_path_is_refused(drive, name):
    back = dataclasses.replace(drive.cameras[1], name=name)
    hostile = dataclasses.replace(drive, cameras=(drive.cameras[0], back))
    with pytest.raises(UserError, match="no name of a folder"):
        assemble(hostile, PLAIN)


def test_laser_points_are_told_apart_by_what_they_lie_on(drive):
    scene = assemble(drive, PLAIN)
    assert scene.lidar is not None
    # The standing car is in the same place and owns nothing: it is part of the static scene.
    assert (scene.lidar.objects == 0).sum() == 50 * FRAMES
    assert (scene.lidar.objects == -1).sum() == 200 * FRAMES
    assert np.isfinite(scene.lidar.points).all()
    assert len(scene.points)
    assert np.linalg.norm(scene.points + scene.origin - FAR, axis=1).min() > 30
    assert scene.point_colors is None
    assert any("LiDAR" in note for note in scene.notes)


def test_cameras_and_frames_are_chosen_and_sweeps_with_them(drive):
    scene = assemble(drive, DataConfig(own_car=False, cameras=("front",), frames="1:5:2"))
    assert [(v.camera, v.frame) for v in scene.views] == [("CAM_FRONT", 1), ("CAM_FRONT", 3)]
    assert scene.lidar is not None
    assert set(np.round(scene.lidar.times, 3)) == {0.0, 0.1, 0.2, 0.3, 0.4}
    with pytest.raises(UserError, match="no camera 'left'"):
        assemble(drive, DataConfig(own_car=False, cameras=("left",)))


def test_without_lidar_there_are_no_seeds_yet(drive):
    scene = assemble(drive, DataConfig(own_car=False, lidar=False))
    assert scene.lidar is None
    assert not len(scene.points)
    assert any("--data.no-lidar" in note for note in scene.notes)


def test_every_camera_holds_out_the_same_frames(drive):
    few = [p for p in drive.photographs if (p.camera, p.frame) != ("CAM_BACK", 0)]
    scene = assemble(Recording(drive.root, "made", drive.cameras, tuple(few)), PLAIN)
    assert any("CAM_BACK 5" in note for note in scene.notes)
    split = assign_split(scene.views, 4)
    assert {(v.camera, v.frame) for v in split if v.split == "test"} == {
        ("CAM_BACK", 4),
        ("CAM_FRONT", 0),
        ("CAM_FRONT", 4),
    }


def test_missing_photographs_stop_or_are_counted(drive):
    drive.photographs[0].path.unlink()
    with pytest.raises(UserError, match=r"1 of the 12 images .*CAM_FRONT/00.png"):
        assemble(drive, PLAIN)
    scene = assemble(drive, DataConfig(own_car=False, allow_missing=True))
    assert len(scene.views) == 11
    assert any("CAM_FRONT/00.png" in note for note in scene.notes)
    with pytest.raises(UserError, match="no photograph with a pose"):
        assemble(Recording(drive.root, "made", drive.cameras, ()), PLAIN)


def test_embedded_photographs_are_written_once(drive, tmp_path):
    asked = []

    def embedded() -> bytes:
        asked.append(1)
        out = io.BytesIO()
        picture().save(out, "PNG")
        return out.getvalue()

    photographs = tuple(
        Photograph("CAM_FRONT", k, k / 10, Path(f"{k}.png"), pose(k, 0.0), embedded)
        for k in range(3)
    )
    recording = Recording(drive.root, "made", drive.cameras, photographs)
    for _ in range(2):
        scene = assemble(recording, PLAIN, tmp_path / "work")
    assert len(asked) == 3
    assert all(view.image_path.is_file() for view in scene.views)
    assert scene.views[0].image_path.is_relative_to(tmp_path / "work")


def test_rolling_shutters_are_said(drive):
    cameras = tuple(RigCamera(c.name, K, WIDTH, HEIGHT, readout_s=0.03) for c in drive.cameras)
    scene = assemble(Recording(drive.root, "made", cameras, drive.photographs), PLAIN)
    assert any("rolling shutters (up to 30 ms" in note for note in scene.notes)


# ------------------------------------------------------------------ the parts


def test_cameras_are_named_as_people_say_them():
    assert short_name("CAM_FRONT_LEFT") == short_name("front_left_camera") == "front_left"
    assert short_name("ring_front_center") == "front_center"
    assert short_name("camera") == "camera"
    there = ["front_camera", "front_left_camera", "back_camera"]
    assert chosen_cameras(["front", "back_camera", "Front"], there) == [there[0], there[2]]
    assert chosen_cameras([], there) == there


@pytest.mark.parametrize(
    ("asked", "found"),
    [(None, [3, 4, 5, 7]), ("1:3", [4, 5]), ("::2", [3, 5]), ("-1:", [7])],
)
def test_frames_are_sliced_by_their_place(asked, found):
    assert chosen_frames(asked, [3, 4, 5, 7]) == found


@pytest.mark.parametrize("asked", ["3", "a:b", "1:2:3:4", "9:12", "::0"])
def test_frames_that_make_no_sense_are_refused(asked):
    with pytest.raises(UserError, match="--frames"):
        chosen_frames(asked, [3, 4, 5, 7])


def test_poses_between_poses_turn_evenly_and_end_soon_after_the_last():
    poses = np.stack([pose(0, 0.0), pose(2, 1.0)])
    at = np.array([-0.1, 0.5, 1.0, 1.2])
    found, covered = interpolated(np.array([0.0, 1.0]), poses, at)
    assert covered.tolist() == [True, True, True, False]
    np.testing.assert_allclose(found[1], pose(1, 0.5), atol=1e-12)
    np.testing.assert_allclose(found[0, :3, 3] - FAR, [0, 0, -0.2], atol=1e-9)
    np.testing.assert_allclose(inverse(found) @ found, np.tile(np.eye(4), (4, 1, 1)), atol=1e-9)
    alone, _ = interpolated(np.array([0.0]), poses[:1], at)
    np.testing.assert_array_equal(alone[3], poses[0])


def test_what_is_no_rotation_is_refused():
    source = Path("poses.json")
    with pytest.raises(UserError, match=r"poses.json: the pose of frame 3 is no rotation"):
        rigid(1.1 * np.eye(3), np.zeros(3), source, "frame 3")
    with pytest.raises(UserError, match="mirrors"):
        rigid(np.diag([1.0, 1, -1]), np.zeros(3), source, "frame 3")
    with pytest.raises(UserError, match="no rotation and position"):
        rigid(np.eye(3), np.array([0, np.nan, 0]), source, "frame 3")
    with pytest.raises(UserError, match="no unit quaternion"):
        from_quaternion(np.zeros(4), np.zeros(3), source, "frame 3")
    half = np.sqrt(0.5)
    turned = from_quaternion(np.array([half, 0, 0, half]), np.ones(3), source, "frame 3")
    np.testing.assert_allclose(turned[:3, 0], [0, 1, 0], atol=1e-12)


def test_seeds_are_dense_near_the_path_and_sparse_far_from_it():
    rng = np.random.default_rng(1)
    near, far = (
        rng.uniform(-5, 5, (20_000, 3)),
        rng.uniform(-5, 5, (20_000, 3)) + np.array([80, 0, 0]),
    )
    points = np.concatenate([near, far]).astype(np.float32)
    lidar = Lidar(points, np.zeros(40_000), np.full(40_000, -1))
    kept, _ = seeds(lidar, np.zeros((1, 3)))
    close = (kept[:, 0] < 40).sum()
    assert close > 5 * (len(kept) - close) > 0
    few, angle = seeds(lidar, np.zeros((1, 3)), most=500)
    assert 0 < len(few) <= 500
    assert angle > 0.01
    assert not len(seeds(Lidar(points, np.zeros(40_000), np.zeros(40_000, int)), kept)[0])


def test_nothing_is_owned_where_nothing_is_tracked():
    points = car().poses[:1, :3, 3]
    assert owners(points, np.array([0.0]), [car()]).tolist() == [0]
    # The same place, two seconds after the track ended.
    assert owners(points, np.array([2.5]), [car()]).tolist() == [-1]
    assert owners(points[:0], np.zeros(0), [car()]).shape == (0,)
