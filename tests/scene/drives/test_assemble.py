"""A recording becomes a scene: chosen frames, views, LiDAR points, objects and notes."""

from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
from made_drive import FAR, PERIOD, WALL, camera_pose, make_recording
from scene.helpers import refused

from p2gs_jax.config import DataConfig
from p2gs_jax.scene.drives.assemble import assemble, chosen_frames
from p2gs_jax.scene.drives.lidar import owners, seeds
from p2gs_jax.scene.drives.objects import Box, tracks
from p2gs_jax.scene.drives.recording import SweepPoints, Trajectory
from p2gs_jax.scene.split import assign_split
from p2gs_jax.types import Lidar, TrackedObject

PLAIN = DataConfig(ego_mask=False)
FRAMES = 6


@pytest.fixture
def drive(tmp_path):
    """Return a drive of two cameras; every sweep has a point that is not a number."""
    made = make_recording(tmp_path, ("front", "back"), FRAMES)
    photographs = [replace(p, camera=f"CAM_{p.camera.upper()}") for p in made.photographs]
    cameras = [replace(c, name=f"CAM_{c.name.upper()}") for c in made.cameras]

    def with_nan(sweep):
        points, times = sweep.read()
        return SweepPoints(np.append(points, [[np.nan] * 3], 0), np.append(times, sweep.time))

    sweeps = [replace(s, read=lambda s=s: with_nan(s)) for s in made.sweeps]
    return replace(made, cameras=cameras, photographs=photographs, sweeps=sweeps)


def test_a_drive_becomes_views_with_frames_and_times_near_the_origin(drive):
    scene = assemble(drive, PLAIN)
    assert [v.name for v in scene.views[:2]] == ["CAM_BACK/000001.png", "CAM_BACK/000101.png"]
    assert {v.frame for v in scene.views} == set(range(FRAMES))
    front = next(v for v in scene.views if v.camera == "CAM_FRONT" and v.frame == 3)
    assert front.time == pytest.approx(3 * PERIOD)
    assert np.abs(scene.origin - FAR).max() <= 4
    centre = -front.viewmat[:3, :3].T @ front.viewmat[:3, 3]
    np.testing.assert_allclose(centre + scene.origin, camera_pose("front", 3)[:3, 3], atol=1e-4)
    moved = scene.objects[0].poses[2, :3, 3] + scene.origin
    np.testing.assert_allclose(moved, drive.objects[0].poses[2, :3, 3], atol=1e-9)


@pytest.mark.parametrize("name", ["../../CAM", "/CAM", "CAM/a", "..", "", "CAM\\a"])
def test_a_camera_whose_name_is_a_path_is_refused(drive, name):
    hostile = replace(drive.cameras[1], name=name)
    with refused("is not a valid folder name"):
        assemble(replace(drive, cameras=(drive.cameras[0], hostile)), PLAIN)


def test_laser_points_belong_to_moving_objects_or_the_static_scene(drive):
    scene = assemble(drive, PLAIN)
    # Points on the standing car have no object: it is a part of the static scene.
    assert (scene.lidar.objects == 0).sum() == 60 * FRAMES
    assert (scene.lidar.objects == -1).sum() == 800 * FRAMES
    assert np.isfinite(scene.lidar.points).all()
    assert len(scene.points)
    assert np.abs(np.abs(scene.points[:, 1] + scene.origin[1] - FAR[1]) - WALL).max() < 1e-3
    assert scene.point_colors is None
    assert f"{FRAMES} LiDAR points are not finite numbers and are left out." in scene.notes


def test_repeated_photographs_and_laser_points_without_time_are_counted(drive):
    sweep = drive.sweeps[0]
    points, times = sweep.read()
    times = np.where(np.arange(len(times)) < 5, np.nan, times)
    timeless = replace(sweep, read=lambda: SweepPoints(points, times))
    again = [*drive.photographs, drive.photographs[3]]
    scene = assemble(replace(drive, photographs=again, sweeps=(timeless, *drive.sweeps[1:])), PLAIN)
    assert len({v.name for v in scene.views}) == len(scene.views) == 2 * FRAMES
    assert "1 rows repeat a photograph." in scene.notes
    assert f"{FRAMES + 5} LiDAR points are not finite numbers and are left out." in scene.notes
    assert (scene.lidar.objects == 0).sum() >= 60 * FRAMES - 5


def test_poses_are_not_interpolated_over_long_gaps():
    times = np.array([0.0, 0.1, 0.2, 0.3, 3.3, 3.4])
    drives = Trajectory(times, np.tile(np.eye(4), (6, 1, 1)))
    at = np.array([-0.1, 0.15, 0.4, 0.6, 2.0, 3.2, 3.35, 3.6])
    covered = [True, True, True, False, False, True, True, False]
    assert drives.at(at)[1].tolist() == covered
    # Boxes of keyframes are 0.5 s apart, and some are missing.
    slow = Trajectory(np.array([0, 0.5, 1.0, 2.5]), np.tile(np.eye(4), (4, 1, 1)))
    assert slow.at(np.array([0.25, 1.7]))[1].all()


def test_cameras_and_frames_are_chosen_and_lidar_may_be_left_out(drive):
    scene = assemble(drive, DataConfig(ego_mask=False, cameras=("front",), frames="1:5:2"))
    assert [(v.camera, v.frame) for v in scene.views] == [("CAM_FRONT", 1), ("CAM_FRONT", 3)]
    assert set(np.round(scene.lidar.times, 3)) == {0.0, 0.1, 0.2, 0.3, 0.4}
    with refused("no camera 'left'"):
        assemble(drive, DataConfig(ego_mask=False, cameras=("left",)))
    scene = assemble(drive, DataConfig(ego_mask=False, lidar=False))
    assert scene.lidar is None
    assert not len(scene.points)
    assert any("--data.no-lidar" in note for note in scene.notes)


def test_every_camera_holds_out_the_same_frames(drive):
    few = [p for p in drive.photographs if (p.camera, p.frame) != ("CAM_BACK", 0)]
    scene = assemble(replace(drive, photographs=few, sweeps=()), PLAIN)
    assert any("CAM_BACK 5" in note for note in scene.notes)
    assert any("no LiDAR sweep" in note for note in scene.notes)
    held_out = {(v.camera, v.frame) for v in assign_split(scene.views, 4) if v.split == "test"}
    assert held_out == {("CAM_BACK", 4), ("CAM_FRONT", 0), ("CAM_FRONT", 4)}


def test_calibration_is_compared_with_the_photographs(drive):
    def assembled(size):
        for photograph in drive.photographs:
            if photograph.camera == "CAM_FRONT":
                cv2.imwrite(str(photograph.path), np.zeros((*size, 3), np.uint8))
        return assemble(drive, PLAIN)

    scene = assembled((32, 48))
    front, back = (
        next(v for v in scene.views if v.camera == f"CAM_{n}") for n in ("FRONT", "BACK")
    )
    assert (front.width, front.height) == (48, 32)
    np.testing.assert_allclose(front.K[:2], back.K[:2] / 2)
    assert any("6 images have another size than the calibration states" in n for n in scene.notes)
    with refused(r"wrong size: .*is 64x96"):
        assembled((96, 64))
    assembled((64, 96))
    aside = np.array([[0, 0, 40], [0, 0, 0], [0, 0, 0]])
    shifted = [replace(c, K=c.K + aside) for c in drive.cameras]
    with refused("principal point at 88, 32, far from the middle"):
        assemble(replace(drive, cameras=shifted), PLAIN)


def test_missing_photographs_are_refused_or_left_out_with_a_note(drive):
    drive.photographs[0].path.unlink()
    with refused(r"1 of the 12 images .*CAM_FRONT/000000.png"):
        assemble(drive, PLAIN)
    scene = assemble(drive, DataConfig(ego_mask=False, allow_missing=True))
    assert len(scene.views) == 11
    assert any("CAM_FRONT/000000.png" in note for note in scene.notes)
    with refused("no photograph with a pose"):
        assemble(replace(drive, photographs=()), PLAIN)


def test_embedded_photographs_are_written_once(drive, tmp_path):
    embedded = Mock(side_effect=drive.photographs[0].path.read_bytes)
    first = drive.photographs[:3]
    photographs = [replace(p, path=Path(f"{p.frame}.png"), embedded=embedded) for p in first]
    for _ in range(2):
        scene = assemble(replace(drive, photographs=photographs), PLAIN, tmp_path / "work")
    assert embedded.call_count == 3
    assert all(view.image_path.is_file() for view in scene.views)
    assert scene.views[0].image_path.is_relative_to(tmp_path / "work")


def test_frames_are_sliced_by_their_index_and_invalid_slices_are_refused():
    existing = [3, 4, 5, 7]
    for choice, found in ((None, existing), ("1:3", [4, 5]), ("::2", [3, 5]), ("-1:", [7])):
        assert chosen_frames(choice, existing) == found
    for choice in ("3", "a:b", "1:2:3:4", "9:12", "::0"):
        with refused("--frames"):
            chosen_frames(choice, existing)


def test_seeds_are_dense_near_the_path_and_sparse_far_from_it():
    near, far = np.random.default_rng(1).uniform(-5, 5, (2, 20_000, 3))
    points = np.concatenate([near, far + np.array([80, 0, 0])]).astype(np.float32)
    lidar = Lidar(points, np.zeros(40_000), np.full(40_000, -1))
    kept, _ = seeds(lidar, np.zeros((1, 3)))
    close = (kept[:, 0] < 40).sum()
    assert close > 5 * (len(kept) - close) > 0
    few, _ = seeds(lidar, np.zeros((1, 3)), most=500)
    assert 0 < len(few) <= 500


@pytest.mark.parametrize(
    ("xs", "stated", "moves"),
    [
        ((0, 0.4, -0.3, 0.2), None, False),
        ((0, 0.7, 1.4), None, True),
        ((0, 3, 0), None, True),
        # A statement of the data set overrules the positions.
        ((0,), True, True),
        ((0, 9), False, False),
    ],
)
def test_an_object_moves_if_it_leaves_its_first_place(xs, stated, moves):
    poses = np.tile(np.eye(4), (len(xs), 1, 1))
    poses[:, 0, 3] = xs
    boxes = [Box("a", "Car", (4, 2, 1.5), k, pose, stated) for k, pose in enumerate(poses)]
    (found,) = tracks(boxes)
    assert found.moving is moves
    # Boxes are sorted by time; the first of two boxes at one time counts.
    (again,) = tracks([*boxes[::-1], boxes[0]._replace(pose=9 * poses[0])])
    np.testing.assert_array_equal(again.poses, poses)
    assert again.size == (4.0, 2.0, 1.5)


def test_points_between_two_boxes_of_a_fast_object_belong_to_it():
    """At 2 Hz and 30 m/s boxes are 15 m apart."""
    times = np.arange(4) / 2
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, 0, 3] = 30 * times
    car = TrackedObject("1", "Car", (4.6, 1.9, 1.6), times, poses, moving=True)
    at = np.linspace(0, 1.5, 61)
    points = np.stack([30 * at + 2.0, 0 * at, 0 * at], 1)
    np.testing.assert_array_equal(owners(points, at, [car]), 0)
