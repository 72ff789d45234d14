"""KITTI's tracking benchmark by its readme, with the sensors of `writers_kitti`."""

from pathlib import Path

import numpy as np
from scene.drives import writers as w
from scene.drives import writers_kitti as raw
from scipy.spatial.transform import Rotation

SEQUENCE, SET = "0006", Path("training")
CALIBRATION, OXTS, LABELS = (
    SET / f"{part}/{SEQUENCE}.txt" for part in ("calib", "oxts", "label_02")
)
TO_CAMERA = raw.R_RECT @ raw.VELO_TO_CAM
TURN_Y = 0.4  # radians


def label(frame, track, kind, middle, turn=TURN_Y) -> str:
    """Return a line of a box whose middle is in the scanner's axes."""
    x, y, z = w.applied(TO_CAMERA, np.asarray(middle)[None])[0]
    seen = f"{frame} {track} {kind} 0 0 -10 0 0 9 9"
    return f"{seen} 1.5 1.8 4.2 {x:.9f} {y + 0.75:.9f} {z:.9f} {turn:.9f}\n"


def box(place) -> np.ndarray:
    """Return the box in the scanner's axes: x forward, y left, z up, turned about a camera's y."""
    c, s = np.cos(TURN_Y), np.sin(TURN_Y)
    rotation = TO_CAMERA[:3, :3].T @ np.array([[c, s, 0], [0, 0, -1], [-s, c, 0]])
    return w.matrix(Rotation.from_matrix(rotation), [*place, -0.5])


def write(root: Path, frames=3) -> w.Made:
    ats = raw.TURN * np.arange(frames)
    lines = [f"P{int(name)}: {raw.numbers(P)}" for name, P in raw.P_RECT.items()]
    lines += [f"R_rect {raw.numbers(raw.R_RECT[:3, :3])}"]
    lines += [f"Tr_velo_cam {raw.numbers(raw.VELO_TO_CAM[:3])}"]
    lines += [f"Tr_imu_velo {raw.numbers(raw.IMU_TO_VELO[:3])}"]
    w.write_bytes(root / CALIBRATION, "\n".join(lines) + "\n")
    w.write_bytes(root / OXTS, "".join(map(raw.oxts, ats)))
    parked, labels = raw.scanner(0) @ box(w.AHEAD), ""
    for k, at in enumerate(ats):
        for name in raw.LAG:
            w.write_bytes(root / SET / f"{name}/{SEQUENCE}/{k:06d}.png", raw.PICTURE)
        w.write_bytes(root / SET / f"velodyne/{SEQUENCE}/{k:06d}.bin", raw.scan(at))
        labels += label(k, 0, "ahead", [*w.AHEAD, -0.5]) + label(k, 1, "right", [*w.RIGHT, -0.5])
        labels += label(k, 2, "parked", raw.local_when_passed(parked[:3, 3], at))
        labels += f"{k} -1 DontCare -1 -1 -10 1 2 3 4 -1 -1 -1 -1000 -1000 -1000 -10\n"
    w.write_bytes(root / LABELS, labels)
    return w.Made(
        root=root,
        photographs={
            (name, k): (at, raw.camera(name, at)) for name in raw.LAG for k, at in enumerate(ats)
        },
        sweeps=list(ats),
        error=lambda points: w.off_landmarks(points, w.car_at(0)[:3, 3]),
        boxes=raw.tracks(ats, box),
        tables=[CALIBRATION, OXTS],
        optional=[LABELS],
        scans=[SET / f"velodyne/{SEQUENCE}/{k:06d}.bin" for k in range(frames)],
    )
