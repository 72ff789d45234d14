"""KITTI's raw recordings, from the formulas of its readme."""

from pathlib import Path

import cv2
import numpy as np
from scene.drives import writers as w
from scipy.spatial.transform import Rotation

EARTH, LATITUDE, LONGITUDE = 6378137.0, 49.0, 8.4
TURN = 0.1  # seconds of a scanner's turn
# The reader's clock when the drive begins, s.
START = np.datetime64("2011-09-26T13:02:25", "ns")
BEGIN = START.astype(int) * 1e-9
DATE, DRIVE = "2011_09_26", "2011_09_26_drive_0001_sync"
BOXES = Path(DRIVE) / "tracklet_labels.xml"
# Seconds from a frame's time until the scanner looks forward, and until photographs.
SCANNED, LAG = 0.0035, {"image_02": 0.003, "image_03": 0.004}


def small(angles, position) -> np.ndarray:
    return w.matrix(Rotation.from_euler("zyx", angles, degrees=True), position)


IMU_TO_VELO = small([0.3, -0.2, 0.5], [-0.81, 0.32, -0.8])
# Axes of a camera, then a small turn.
VELO_TO_CAM = small([0.5, 0.3, -0.4], [-0.01, -0.08, -0.27]) @ np.array(
    [[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1.0]]
)
R_RECT = small([0.4, 0.2, -0.6], [0, 0, 0])
P_RECT = {
    "02": np.array([[50.0, 0, 31.5, 3.1], [0, 51, 23.5, 0.2], [0, 0, 1, 0.003]]),
    "03": np.array([[50.0, 0, 31.5, -23.5], [0, 51, 23.5, 0.1], [0, 0, 1, 0.002]]),
}


def imu(seconds: float) -> np.ndarray:
    """Return the pose of the GPS unit; the reader's origin is where the drive begins."""
    out = w.car_at(seconds)
    out[:3, 3] -= w.car_at(0)[:3, 3]
    return out


def scanner(seconds: float) -> np.ndarray:
    return imu(seconds) @ w.inv(IMU_TO_VELO)


def camera(name: str, seconds: float) -> np.ndarray:
    """Return camera to world: readme.txt has Y = P_rect R_rect velo_to_cam imu_to_velo X."""
    P = P_RECT[name[-2:]]
    back = w.matrix(Rotation.identity(), -np.linalg.solve(P[:, :3], P[:, 3]))
    return imu(seconds) @ w.inv(R_RECT @ VELO_TO_CAM @ IMU_TO_VELO) @ back


def local_when_passed(place: np.ndarray, forward: float) -> np.ndarray:
    """Return a place in the scanner's axes at the moment when its beam passes the place.

    The scanner turns clockwise from its back and looks forward at the time `forward`, s.
    """
    at = forward
    for _ in range(20):
        local = w.inv(scanner(at)) @ [*place, 1]
        at = forward - TURN * np.arctan2(local[1], local[0]) / (2 * np.pi)
    return local[:3]


PICTURE = cv2.imencode(".png", np.full((w.HEIGHT, w.WIDTH, 3), 90, np.uint8))[1].tobytes()


def scan(forward: float) -> bytes:
    """Return the file of a sweep of the landmarks."""
    places = w.landmarks() - w.car_at(0)[:3, 3]
    seen = np.array([local_when_passed(place, forward) for place in places])
    return np.column_stack([seen, np.ones(len(seen))]).astype("<f4").tobytes()


def write_stamps(path: Path, times) -> None:
    stamps = [START + np.timedelta64(round(t * 1e9), "ns") for t in times]
    w.write_bytes(path, "".join(f"{stamp}\n".replace("T", " ") for stamp in stamps))


def numbers(values) -> str:
    return " ".join(f"{v:.12e}" for v in np.ravel(values))


def rigid(pose: np.ndarray) -> str:
    return f"R: {numbers(pose[:3, :3])}\nT: {numbers(pose[:3, 3])}\n"


def oxts(seconds: float) -> str:
    """Return a line of the GPS unit: the inverse of convertOxtsToPose.m."""
    pose = imu(seconds)
    scale = EARTH * np.cos(np.radians(LATITUDE))
    start = scale * np.log(np.tan((90 + LATITUDE) * np.pi / 360))
    longitude = LONGITUDE + np.degrees(pose[0, 3] / scale)
    latitude = np.degrees(2 * np.arctan(np.exp((start + pose[1, 3]) / scale))) - 90
    yaw, pitch, roll = Rotation.from_matrix(pose[:3, :3]).as_euler("ZYX")
    head = [f"{v:.16e}" for v in (latitude, longitude, 110 + pose[2, 3], roll, pitch, yaw)]
    return " ".join([*head, *["0"] * 24]) + "\n"


def tracklet(label: str, first: int, rows) -> str:
    """Return a tracklet of rows x y z yaw: the middle of the bottom, in the scanner's axes."""
    poses = "".join(
        f"<item><tx>{x:.9f}</tx><ty>{y:.9f}</ty><tz>{z:.9f}</tz><rx>0</rx><ry>0</ry>"
        f"<rz>{yaw:.9f}</rz></item>"
        for x, y, z, yaw in rows
    )
    return (
        f"<item><objectType>{label}</objectType><h>1.5</h><w>1.8</w><l>4.2</l>"
        f"<first_frame>{first}</first_frame><poses>{poses}</poses></item>"
    )


def tracklets(*items: str) -> str:
    return (
        '<?xml version="1.0" encoding="UTF-8" standalone="yes" ?>\n'
        "<!DOCTYPE boost_serialization>\n"
        f"<boost_serialization><tracklets>{''.join(items)}</tracklets></boost_serialization>\n"
    )


def box(place) -> np.ndarray:
    return small([20, 0, 0], [*place, -0.5])


def tracks(ats, box, clock=0.0) -> dict:
    """Return the truth of boxes at times; `box` places them in the scanner's axes."""
    late = {"ahead": 0, "right": 0.25 * TURN}

    def box_at(time, place):
        return scanner(time + late["right"] * (place == w.RIGHT)) @ box(place)

    return w.tracks(ats, late, box_at, clock)


def write(root: Path, frames=3) -> w.Made:
    """Write a drive below the folder of a date."""
    date = root / DATE
    drive = date / DRIVE
    lines = ["calib_time: 09-Jan-2012 13:57:47", f"R_rect_00: {numbers(R_RECT[:3, :3])}"]
    lines += [f"P_rect_{name}: {numbers(P)}" for name, P in P_RECT.items()]
    w.write_bytes(date / "calib_cam_to_cam.txt", "\n".join(lines) + "\n")
    w.write_bytes(date / "calib_velo_to_cam.txt", rigid(VELO_TO_CAM))
    w.write_bytes(date / "calib_imu_to_velo.txt", rigid(IMU_TO_VELO))
    ats = 0.1 * np.arange(frames)
    forward = ats + SCANNED
    for name, lag in {"oxts": 0.0, "velodyne_points": SCANNED, **LAG}.items():
        write_stamps(drive / name / "timestamps.txt", ats + lag)
    write_stamps(drive / "velodyne_points/timestamps_start.txt", forward - TURN / 2)
    write_stamps(drive / "velodyne_points/timestamps_end.txt", forward + TURN / 2)
    for k, at in enumerate(ats):
        w.write_bytes(drive / f"oxts/data/{k:010d}.txt", oxts(at))
        for name in LAG:
            w.write_bytes(drive / f"{name}/data/{k:010d}.png", PICTURE)
        w.write_bytes(drive / f"velodyne_points/data/{k:010d}.bin", scan(forward[k]))
    parked = scanner(SCANNED) @ box(w.AHEAD)
    yaw, moving = np.radians(20), {"ahead": w.AHEAD, "right": w.RIGHT}
    things = {name: [[*place, -1.25, yaw]] * frames for name, place in moving.items()}
    stands = [local_when_passed(parked[:3, 3], at) - [0, 0, 0.75] for at in forward]
    things["parked"] = [[*s, yaw - 0.3 * at] for s, at in zip(stands, ats, strict=True)]
    boxes = tracklets(*(tracklet(name, 0, rows) for name, rows in things.items()))
    w.write_bytes(date / BOXES, boxes)
    return w.Made(
        root=date,
        photographs={
            (name, k): (BEGIN + at + lag, camera(name, at + lag))
            for name, lag in LAG.items()
            for k, at in enumerate(ats)
        },
        sweeps=list(BEGIN + forward),
        error=lambda points: w.off_landmarks(points, w.car_at(0)[:3, 3]),
        boxes=tracks(forward, box, BEGIN),
        tables=[Path(f"calib_{name}.txt") for name in ("cam_to_cam", "velo_to_cam", "imu_to_velo")]
        + [Path(DRIVE) / folder / "timestamps.txt" for folder in ("oxts", "image_03")],
        optional=[BOXES],
        scans=[Path(DRIVE) / f"velodyne_points/data/{k:010d}.bin" for k in range(frames)],
    )
