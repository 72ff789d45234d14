"""A small drive, as readers give it: a car between walls, cameras all round, LiDAR, boxes."""

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from p2gs_jax.scene.drives.recording import Photograph, Recording, RigCamera, Sweep, SweepPoints
from p2gs_jax.scene.rigid import pose_of
from p2gs_jax.types import TrackedObject

WIDTH, HEIGHT, FOCAL = 96, 64, 48.0
K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1.0]])
AZIMUTHS = {"front": 0.0, "front_left": 45.0, "left": 90.0, "back": 180.0, "right": -90.0}
SPEED, PERIOD, FAR = 10.0, 0.1, np.array([3000.0, 500.0, 20.0])  # m/s, s; the car's start, m
# OpenCV's axes (x right, y down, z forward) in the car's axes (x forward, y left, z up).
FORWARD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
WALL = 6.0  # m beside the car


def camera_pose(camera, frame):
    """Return the camera-to-world matrix; the car drives along x."""
    turn = Rotation.from_euler("z", AZIMUTHS[camera], degrees=True).as_matrix()
    return pose_of(turn @ FORWARD, FAR + np.array([SPEED * PERIOD * frame, 0, 1.6]))


def tracked_car(frames, moving=True):
    """Return a car that overtakes on the left, or one that stands on the right."""
    times = PERIOD * np.arange(frames)
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, :3, 3] = FAR + ([4.0, 3.5, 0.8] if moving else [10.0, -4.0, 0.8])
    if moving:
        poses[:, 0, 3] += 1.5 * SPEED * times
    return TrackedObject("a" if moving else "b", "Car", (4.0, 2.0, 1.6), times, poses, moving)


def sweep_points(frame, frames):
    """Return points of the walls and of the moving car in a frame."""
    rng = np.random.default_rng(frame)
    wall = rng.uniform([-20, 0, 0], [30, 0, 5], (800, 3))
    wall[:, 1] = np.where(np.arange(800) % 2, WALL, -WALL)
    car = tracked_car(frames).poses[frame, :3, 3] + rng.uniform(-1, 1, (60, 3)) * [1.9, 0.9, 0.7]
    return np.concatenate([wall + FAR, car])


def make_recording(root, cameras=("front", "left", "back", "right"), frames=8):
    """Write photographs of grey noise, and return the drive."""
    photographs = []
    rng = np.random.default_rng(0)
    for k, camera in enumerate(cameras):
        (root / camera).mkdir(parents=True, exist_ok=True)
        for frame in range(frames):
            # Data sets name files by time stamps that differ between cameras.
            path = root / camera / f"{100 * frame + k:06d}.png"
            picture = 110 + 20 * cv2.blur(rng.standard_normal((HEIGHT, WIDTH, 3)), (7, 7))
            cv2.imwrite(str(path), np.rint(picture).astype(np.uint8))
            at = PERIOD * frame + 0.01 * k
            photographs.append(Photograph(camera, frame, at, path, camera_pose(camera, frame)))

    def read(frame):
        points = sweep_points(frame, frames)
        return SweepPoints(points, np.full(len(points), PERIOD * frame))

    rig = [RigCamera(name, K, WIDTH, HEIGHT) for name in cameras]
    sweeps = [Sweep(PERIOD * k, lambda k=k: read(k)) for k in range(frames)]
    cars = (tracked_car(frames), tracked_car(frames, moving=False))
    return Recording(root, "pandaset", rig, photographs, sweeps, cars)
