"""Real recordings: one keyframe of nuScenes, a sequence of PandaSet, stills of KITTI."""

import shutil

import cv2
import numpy as np
import pytest
from scene.drives import writers_kitti as kitti
from scene.drives.writers import applied

from p2gs_jax.scene.drives.lidar import owners
from p2gs_jax.scene.drives.tables import read_pickled
from p2gs_jax.scene.rigid import inverse


def project(points, to_camera, K):
    local = applied(to_camera, points)
    with np.errstate(divide="ignore"):
        return (local @ K.T)[:, :2] / local[:, 2:], local[:, 2]


def test_laser_points_project_into_images_at_their_times(shared_data, read):
    drive = read(shared_data("nuscenes_one_frame"))
    assert drive.notes[0] == "scene.json counts 39 samples, but sample.json holds 1."
    points, times = drive.sweeps[0].read()
    assert len(points) == 34688
    assert len(drive.photographs) == 6
    cameras = {c.name: c for c in drive.cameras}
    for photograph in drive.photographs:
        camera, to_camera = cameras[photograph.camera], inverse(photograph.pose)
        xy, z = project(points, to_camera, camera.K)
        front = z > 1
        xy = xy[front]
        inside = ((xy >= 0) & (xy < [camera.width, camera.height])).all(1)
        assert 3000 < inside.sum() < 4900
        # Cameras are triggered as the scanner passes the middle of their images.
        middle = np.abs(xy[:, 0] / camera.width - 0.5) < 0.05
        passed = np.median(times[front][inside & middle])
        assert photograph.time - passed == pytest.approx(0.002, abs=0.0006)


def test_boxes_have_the_times_at_which_the_scanner_passed_them(shared_data, read):
    """Points of the spinning scanner have times; points in a box have the time of the box."""
    sequence, apart = read(shared_data("pandaset_002")), []
    for path in sorted((sequence.root / "lidar").glob("*.pkl.gz")):
        table = read_pickled(path)
        spinning = table["d"] == 0
        points = np.stack([table[a][spinning] for a in "xyz"], 1)
        times = table["t"][spinning]
        row = owners(points, times, sequence.objects)
        for k in set(row[row >= 0]):
            apart.append(np.abs(sequence.objects[k].times - np.median(times[row == k])).min())
    assert len(apart) > 50
    assert np.median(apart) < 0.002
    assert np.quantile(apart, 0.9) < 0.006


def test_scans_agree_with_the_disparity_of_the_real_photographs(shared_data, read, tmp_path):
    """Four stills of KITTI's stereo benchmark as frames of a car that stands."""
    source = shared_data("kitti2015_stereo_lidar")
    drive = tmp_path / "2011_09_26" / "2011_09_26_drive_0001_sync"
    drive.mkdir(parents=True)
    for path in source.glob("calib_*.txt"):
        shutil.copy(path, drive.parent)
    stills = sorted(p.stem for p in (source / "velodyne").iterdir())
    for name in ("oxts", "image_02", "image_03", "velodyne_points"):
        (drive / name / "data").mkdir(parents=True)
        kitti.write_stamps(drive / name / "timestamps.txt", 10.0 * np.arange(len(stills)))
    for k, still in enumerate(stills):
        for camera in ("2", "3"):
            link = drive / f"image_0{camera}/data/{k:010d}.png"
            link.symlink_to(source / f"image_{camera}/{still}.png")
        (drive / f"velodyne_points/data/{k:010d}.bin").symlink_to(source / f"velodyne/{still}.bin")
        (drive / f"oxts/data/{k:010d}.txt").write_text("49 8.4 110 0.01 -0.02 0.7 " + "0 " * 24)
    recording = read(drive)
    assert recording.format == "kitti_raw"
    K = recording.cameras[0].K
    for frame, (sweep, still) in enumerate(zip(recording.sweeps, stills, strict=True)):
        pair = [p for p in recording.photographs if p.frame == frame]
        xy, z = project(sweep.read().points, inverse(pair[0].pose), K)
        truth = cv2.imread(str(source / f"disp_occ_0/{still}.png"), cv2.IMREAD_UNCHANGED) / 256.0
        height, width = truth.shape
        inside = (z > 1) & (xy >= 0).all(1) & (xy < [width, height]).all(1)
        column, row = xy[inside].astype(int).T
        disparity = truth[row, column]
        known = disparity > 0
        # Cameras are where their projections state, so depths agree with disparities.
        baseline = np.linalg.norm(pair[0].pose[:3, 3] - pair[1].pose[:3, 3])
        ratio = z[inside][known] / (K[0, 0] * baseline / disparity[known])
        assert len(ratio) > 1000
        assert np.median(ratio) == pytest.approx(1.0, abs=0.01)
        assert np.mean(np.abs(ratio - 1) < 0.05) > 0.75
