"""Waymo's recordings in the layout that drivestudio's preprocessing writes."""

import json
from pathlib import Path

import numpy as np
from scene.drives import writers as w
from scene.drives import writers_waymo as waymo

NAMES = {0: "FRONT", 1: "FRONT_LEFT"}
TURN = 0.1  # seconds of a scanner's turn
BOXES = Path("instances/instances_info.json")


def text(values) -> str:
    """Return values in the format of numpy.savetxt."""
    return "".join(" ".join(f"{v:.18e}" for v in np.atleast_1d(row)) + "\n" for row in values)


def instance(track, poses) -> dict:
    annotations = {
        "frame_idx": list(range(len(poses))),
        "obj_to_world": [pose.tolist() for pose in poses],
        "box_size": [list(w.SIZE)] * len(poses),
    }
    return {"id": track, "class_name": "Vehicle", "frame_annotations": annotations}


def write(root: Path, frames=3) -> w.Made:
    ats = TURN * np.arange(frames)
    for camera in NAMES:
        lens = [50.0, 51.0, 32.0, 24.0, 0.05, -0.02, 1e-3, -1e-3, 0.0]
        w.write_bytes(root / f"intrinsics/{camera}.txt", text(lens))
        w.write_bytes(root / f"extrinsics/{camera}.txt", text(waymo.mount(camera + 1)))
    for k, at in enumerate(ats):
        car = w.car_at(at)
        w.write_bytes(root / f"ego_pose/{k:03d}.txt", text(car))
        for camera in NAMES:
            w.write_bytes(root / f"images/{k:03d}_{camera}.jpg", w.jpeg(10 * k + camera))
        rows = np.zeros((len(w.landmarks()), 14), "<f4")
        rows[:, :3] = [1.43, 0, 2.18]
        rows[:, 3:6] = w.applied(w.inv(car), w.landmarks())
        w.write_bytes(root / f"lidar/{k:03d}.bin", rows.tobytes())
    cars = [w.car_at(at) for at in ats]
    moving = {"ahead": w.AHEAD, "right": w.RIGHT}
    things = {name: [car @ waymo.box(place) for car in cars] for name, place in moving.items()}
    things["parked"] = [cars[0] @ waymo.box(w.AHEAD)] * frames
    table = {str(k): instance(*item) for k, item in enumerate(things.items())}
    w.write_bytes(root / BOXES, json.dumps(table))
    return w.Made(
        root=root,
        photographs={
            (NAMES[c], k): (at, w.car_at(at) @ waymo.mount(c + 1) @ w.OPENCV)
            for c in NAMES
            for k, at in enumerate(ats)
        },
        sweeps=list(ats),
        # The scanner looks forward in the middle of its turn.
        boxes=w.tracks(
            ats, {"ahead": 0.0, "right": 0.25 * TURN}, lambda t, p: w.car_at(t) @ waymo.box(p)
        ),
        tables=[Path(f"{name}/0.txt") for name in ("intrinsics", "extrinsics")],
        optional=[BOXES, Path("ego_pose/001.txt")],
        scans=[Path(f"lidar/{k:03d}.bin") for k in range(frames)],
    )
