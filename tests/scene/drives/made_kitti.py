"""Small recordings in KITTI's layouts, written from the formulas of its readmes."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from p2gs_jax.errors import UserError
from p2gs_jax.scene.drives.recording import Recording

WIDTH, HEIGHT = 64, 48
EARTH = 6378137.0
LATITUDE, LONGITUDE = 49.0, 8.4
SPEED, TURN_RATE = 12.0, 0.05
TURN = 0.1
# When the scanner looks forward in raw drives, seconds after each frame begins.
SCANNED = 0.0035


def square(rows) -> np.ndarray:
    return np.vstack([np.reshape(rows, (3, 4)), [0, 0, 0, 1]])


def placed(angles, position) -> np.ndarray:
    out = np.eye(4)
    out[:3, :3] = Rotation.from_euler("zyx", angles, degrees=True).as_matrix()
    out[:3, 3] = position
    return out


def car(t) -> np.ndarray:
    """Return the car's poses at times: x forward, y left, z up; it begins at the origin."""
    t = np.asarray(t, float)
    out = np.tile(np.eye(4), (*t.shape, 1, 1))
    angles = np.stack([0.4 + TURN_RATE * t, 0.02 + 0 * t, -0.01 + 0 * t], -1)
    turns = Rotation.from_euler("ZYX", angles.reshape(-1, 3)).as_matrix()
    out[..., :3, :3] = turns.reshape(*t.shape, 3, 3)
    out[..., :3, 3] = t[..., None] * [SPEED * np.cos(0.4), SPEED * np.sin(0.4), 0.02]
    return out


IMU_TO_VELO = placed([0.3, -0.2, 0.5], [-0.81, 0.32, -0.8])
# Axes of a camera, then a small turn.
VELO_TO_CAM = placed([0.5, 0.3, -0.4], [-0.01, -0.08, -0.27]) @ np.array(
    [[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1.0]]
)
R_RECT = placed([0.4, 0.2, -0.6], [0, 0, 0])
P_RECT = {
    "02": np.array([[50.0, 0, 31, 3.1], [0, 50, 23, 0.2], [0, 0, 1, 0.003]]),
    "03": np.array([[50.0, 0, 31, -23.5], [0, 50, 23, 0.1], [0, 0, 1, 0.002]]),
}


def world_points(seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.uniform([-30, -30, -2], [60, 60, 4], (400, 3))


def scan(points: np.ndarray, forward: float, scanner) -> tuple[np.ndarray, np.ndarray]:
    """Return (points in the scanner's axes at their own times, rows that were seen).

    The scanner turns clockwise from its back and looks forward in the middle of its turn.
    """
    homogeneous = np.column_stack([points, np.ones(len(points))])
    at = np.full(len(points), forward)
    for _ in range(20):
        local = np.einsum("nij,nj->ni", np.linalg.inv(scanner(at)), homogeneous)[:, :3]
        azimuth = np.arctan2(local[:, 1], local[:, 0])
        at = forward - TURN * azimuth / (2 * np.pi)
    seen = np.abs(azimuth) < np.radians(170)
    return local[seen], np.flatnonzero(seen)


def write_scan(path: Path, local: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.column_stack([local, np.ones(len(local))]).astype("<f4").tofile(path)


def write_photograph(path: Path, width: int = WIDTH, height: int = HEIGHT) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), np.full((height, width, 3), 90, np.uint8))


def stamp(seconds: float) -> str:
    whole = np.datetime64("2011-09-26T13:02:25", "ns") + np.timedelta64(round(seconds * 1e9), "ns")
    return str(whole).replace("T", " ")


def seconds(text: str) -> float:
    return np.datetime64(text.replace(" ", "T"), "ns").astype(int) * 1e-9


# The clock of the drive at `car(0)`.
BEGIN = seconds("2011-09-26 13:02:25")


def numbers(values) -> str:
    return " ".join(f"{v:.12e}" for v in np.ravel(values))


def write_rigid(path: Path, pose: np.ndarray) -> None:
    path.write_text(
        f"calib_time: 25-May-2012 16:47:16\nR: {numbers(pose[:3, :3])}\nT: {numbers(pose[:3, 3])}\n"
    )


def oxts(t: float) -> str:
    """Return a line of the GPS unit: the inverse of convertOxtsToPose.m."""
    pose = car(t)
    scale = np.cos(np.radians(LATITUDE))
    start = scale * EARTH * np.log(np.tan((90 + LATITUDE) * np.pi / 360))
    longitude = LONGITUDE + np.degrees(pose[0, 3] / (scale * EARTH))
    latitude = np.degrees(2 * np.arctan(np.exp((start + pose[1, 3]) / (scale * EARTH)))) - 90
    yaw, pitch, roll = Rotation.from_matrix(pose[:3, :3]).as_euler("ZYX")
    head = [f"{v:.16e}" for v in (latitude, longitude, 110 + pose[2, 3], roll, pitch, yaw)]
    return " ".join([*head, *["0"] * 24])


def write_raw(root: Path, frames: int = 5) -> Path:
    """Write a raw drive below a date's folder; return the drive's folder."""
    date = root / "2011_09_26"
    drive = date / "2011_09_26_drive_0001_sync"
    drive.mkdir(parents=True)
    lines = ["calib_time: 09-Jan-2012 13:57:47", "corner_dist: 9.950000e-02"]
    lines += [f"R_rect_00: {numbers(R_RECT[:3, :3])}"]
    lines += [f"P_rect_{name}: {numbers(P)}" for name, P in P_RECT.items()]
    (date / "calib_cam_to_cam.txt").write_text("\n".join(lines) + "\n")
    write_rigid(date / "calib_velo_to_cam.txt", VELO_TO_CAM)
    write_rigid(date / "calib_imu_to_velo.txt", IMU_TO_VELO)
    times = {"oxts": 0.0, "image_02": 0.003, "image_03": 0.004, "velodyne_points": SCANNED}
    for name, late in times.items():
        (drive / name / "data").mkdir(parents=True)
        stamps = "".join(stamp(0.1 * k + late) + "\n" for k in range(frames))
        (drive / name / "timestamps.txt").write_text(stamps)
    for name, late in (("start", -TURN / 2), ("end", TURN / 2)):
        stamps = "".join(stamp(0.1 * k + SCANNED + late) + "\n" for k in range(frames))
        (drive / "velodyne_points" / f"timestamps_{name}.txt").write_text(stamps)
    for k in range(frames):
        (drive / f"oxts/data/{k:010d}.txt").write_text(oxts(0.1 * k) + "\n")
        for camera in P_RECT:
            write_photograph(drive / f"image_{camera}/data/{k:010d}.png")
        local, _ = scan(world_points(), 0.1 * k + SCANNED, velo_pose)
        write_scan(drive / f"velodyne_points/data/{k:010d}.bin", local)
    return drive


def velo_pose(t: float) -> np.ndarray:
    return car(t) @ np.linalg.inv(IMU_TO_VELO)


TRACKLET = """<item class_id="1" tracking_level="0" version="1">
<objectType>{label}</objectType><h>1.5</h><w>1.8</w><l>4.2</l><first_frame>{first}</first_frame>
<poses class_id="2" tracking_level="0" version="0"><count>{count}</count>
<item_version>2</item_version>{poses}</poses><finished>1</finished></item>"""
TRACKLET_POSE = """<item class_id="3" tracking_level="0" version="2"><tx>{:.9f}</tx><ty>{:.9f}</ty>
<tz>{:.9f}</tz><rx>0</rx><ry>0</ry><rz>{:.9f}</rz><state>2</state><occlusion>0</occlusion></item>"""


def tracklet(label: str, first: int, rows) -> str:
    """Return a tracklet of rows x y z yaw: the middle of the bottom, in the scanner's axes."""
    poses = "".join(TRACKLET_POSE.format(*row) for row in rows)
    return TRACKLET.format(label=label, first=first, count=len(rows), poses=poses)


def tracklets(*items: str) -> str:
    return (
        '<?xml version="1.0" encoding="UTF-8" standalone="yes" ?>\n'
        "<!DOCTYPE boost_serialization>\n"
        '<boost_serialization signature="serialization::archive" version="9">\n'
        f'<tracklets class_id="0" tracking_level="0" version="0"><count>{len(items)}</count>'
        f"<item_version>1</item_version>{''.join(items)}</tracklets></boost_serialization>\n"
    )


def read_damaged(top: Path, read: Callable[[], Recording | None], times: int = 60) -> int:
    """Read a drive again and again, each time with a file cut, changed or gone.

    Returns how often that ended in a complaint; anything else has to be a sound recording.
    """
    rng = np.random.default_rng(1)
    files = sorted(p for p in top.rglob("*") if p.is_file() and p.suffix not in (".png", ".jpg"))
    complaints = 0
    for _ in range(times):
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
            recording = read()
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
    return complaints
