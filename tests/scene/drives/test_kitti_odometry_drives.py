"""KITTI's odometry benchmark: real photographs and poses in its layout, made scans."""

import shutil

import numpy as np
import pytest
from scene.drives import made_kitti as made

from p2gs_jax.config import DataConfig
from p2gs_jax.errors import UserError
from p2gs_jax.scene import load_scene
from p2gs_jax.scene.drives import read_drive
from p2gs_jax.scene.drives.kitti_odometry import is_kitti_odometry, read_kitti_odometry

CFG = DataConfig()
TR = made.VELO_TO_CAM
FRAMES = 4


def read(root, cfg=CFG):
    return read_kitti_odometry(root, cfg, lambda message: None)


def camera_pose(t):
    """Return rectified camera 0 to its place at 0, as the benchmark gives poses."""
    start = made.car(0.0) @ np.linalg.inv(TR)
    return np.linalg.inv(start) @ made.car(t) @ np.linalg.inv(TR)


@pytest.fixture
def sequence(tmp_path):
    return write_benchmark(tmp_path)


def write_benchmark(root):
    """Write a benchmark, and return its sequence 03."""
    folder = root / "sequences" / "03"
    folder.mkdir(parents=True)
    P = {k: made.P_RECT["02" if k < 3 else "03"] for k in range(4)}
    lines = [f"P{k}: {made.numbers(P[k])}" for k in P] + [f"Tr: {made.numbers(TR[:3])}"]
    (folder / "calib.txt").write_text("\n".join(lines) + "\n")
    (folder / "times.txt").write_text("".join(f"{0.1 * k:e}\n" for k in range(FRAMES)))
    (root / "poses").mkdir()
    rows = [made.numbers(camera_pose(0.1 * k)[:3]) for k in range(FRAMES)]
    (root / "poses" / "03.txt").write_text("\n".join(rows) + "\n")
    points = made.world_points()
    for k in range(FRAMES):
        made.write_photograph(folder / f"image_2/{k:06d}.png")
        made.write_photograph(folder / f"image_3/{k:06d}.png")
        # Scans of the benchmark are as if everything had been measured at the frame's time.
        local = (points - made.car(0.1 * k)[:3, 3]) @ made.car(0.1 * k)[:3, :3]
        made.write_scan(folder / f"velodyne/{k:06d}.bin", local)
    return folder


def test_scans_lie_in_the_world_of_the_first_camera(sequence):
    recording = read(sequence)
    start = made.car(0.0) @ np.linalg.inv(TR)
    expected = (made.world_points() - start[:3, 3]) @ start[:3, :3]
    for sweep in recording.sweeps:
        points, times = sweep.read()
        np.testing.assert_allclose(points, expected, atol=1e-4)
        assert np.abs(times - sweep.time).max() <= 0.05
    assert recording.photographs[1].time == pytest.approx(0.1)


def test_the_benchmark_names_its_sequences(sequence):
    root = sequence.parent.parent
    assert is_kitti_odometry(root)
    assert read(root).root == sequence
    shutil.copytree(sequence, sequence.with_name("04"))
    with pytest.raises(UserError, match="holds 2 drives"):
        read(root)
    assert read(root, DataConfig(drive="03")).root == sequence


def test_a_sequence_of_semantickitti_is_no_rig(sequence):
    shutil.move(sequence.parent.parent / "poses" / "03.txt", sequence / "poses.txt")
    scene = load_scene(sequence, CFG)
    assert scene.format == "kitti_odometry"
    assert len(scene.views) == 2 * FRAMES


def test_a_sequence_without_scans_is_triangulated(shared_data, tmp_path):
    source = shared_data("kitti_stereo_a")
    folder = tmp_path / "sequences" / "00"
    folder.mkdir(parents=True)
    shutil.copy(source / "calib.txt", folder)
    shutil.copy(source / "poses.txt", folder)
    (folder / "times.txt").write_text("".join(f"{0.1 * k}\n" for k in range(40)))
    for k, side in enumerate(("left", "right")):
        (folder / f"image_{k}").mkdir()
        for name in ("000000.png", "000001.png"):
            (folder / f"image_{k}" / name).symlink_to(source / "images" / side / name)
    scene = load_scene(folder, DataConfig(frames="0:2"), tmp_path / "work")
    assert len(scene.views) == 4
    assert len(scene.points) > 100


def test_one_frame(sequence):
    (sequence / "times.txt").write_text("0.0\n")
    recording = read(sequence)
    assert {p.frame for p in recording.photographs} == {0}
    assert len(recording.sweeps) == 1
    assert any("3 frames have no pose or time" in note for note in recording.notes)


def test_what_is_missing_is_counted(sequence):
    (sequence / "velodyne" / "000001.bin").unlink()
    shutil.rmtree(sequence / "image_3")
    (sequence / "image_3").mkdir()
    notes = "\n".join(read(sequence).notes)
    assert "image_3 has no photographs" in notes
    assert "1 of 4 LiDAR sweeps are missing" in notes


BROKEN = {
    "no poses": (lambda s: (s.parent.parent / "poses/03.txt").unlink(), "has no poses"),
    "cut poses": (
        lambda s: (s.parent.parent / "poses/03.txt").write_text("1 0 0 0 0 1 0\n"),
        r"03\.txt, line 1: 7 numbers where 12",
    ),
    "no rotation": (
        lambda s: (s.parent.parent / "poses/03.txt").write_text("2 0 0 0 0 1 0 0 0 0 1 0\n"),
        r"03\.txt: the pose of frame 0 is no rotation",
    ),
    "mirrored scanner": (
        lambda s: (s / "calib.txt").write_text(
            (s / "calib.txt").read_text().split("Tr:")[0] + "Tr: -1 0 0 0 0 1 0 0 0 0 1 0\n"
        ),
        "mirrors",
    ),
    "no scanner": (
        lambda s: (s / "calib.txt").write_text((s / "calib.txt").read_text().split("Tr:")[0]),
        "has no Tr",
    ),
    "no focal length": (
        lambda s: (s / "calib.txt").write_text(f"P2: {made.numbers(np.zeros(12))}\n"),
        "no focal lengths",
    ),
    "words in times": (lambda s: (s / "times.txt").write_text("soon\n"), r"times\.txt: line 1"),
    "no times": (lambda s: (s / "times.txt").write_text("\n"), r"times\.txt is empty"),
    "no photograph": (
        lambda s: (s / "image_2/000000.png").write_bytes(b""),
        "cannot decode the image",
    ),
}


@pytest.mark.parametrize("case", BROKEN, ids=str)
def test_broken_sequences_name_the_file(sequence, case):
    change, message = BROKEN[case]
    change(sequence)
    with pytest.raises(UserError, match=message):
        read(sequence)


def test_damaged_files_end_in_a_recording_or_a_complaint(sequence):
    assert made.read_damaged(sequence.parent.parent, lambda: read_drive(sequence, CFG)) > 10
