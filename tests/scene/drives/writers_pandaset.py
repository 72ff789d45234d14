"""PandaSet: a sequence by its devkit; tables as pandas pickles them."""

import gzip
import json
import pickle
from pathlib import Path

import numpy as np
import pandas as pd
from scene.drives import writers as w

BEGIN = 1557539956.5
CAMERAS = {"front_camera": 0.0, "left_camera": np.pi / 2}
LAG = {"front_camera": -0.05, "left_camera": -0.075}
TURN = 0.1  # seconds of a scanner's turn
FRONT = Path("camera/front_camera")
CUBOIDS = Path("annotations/cuboids")


def put(path: Path, content) -> None:
    w.write_bytes(path, json.dumps(content))


def placed(pose: np.ndarray) -> dict:
    return {
        "position": dict(zip("xyz", map(float, pose[:3, 3]), strict=True)),
        "heading": dict(zip("wxyz", w.wxyz(pose), strict=True)),
    }


def beside(seconds: float, place) -> np.ndarray:
    return w.upright(w.beside(seconds, place, np.pi / 2))


def cuboid(uuid, pose, *, stationary=False, sensor=-1, sibling="-") -> dict:
    """Return a row; a yaw of 0 looks along y, and boxes are long in y."""
    return {
        "uuid": uuid,
        "label": "Car",
        "yaw": w.yaw_of(pose) - np.pi / 2,
        "stationary": stationary,
        **{f"position.{a}": float(v) for a, v in zip("xyz", pose[:3, 3], strict=True)},
        **{"dimensions.x": w.BREADTH, "dimensions.y": w.LENGTH, "dimensions.z": w.TALL},
        "cuboids.sibling_id": sibling,
        "cuboids.sensor_id": sensor,
    }


def cuboids(frame: int) -> list[dict]:
    """Return a box at rest, two that move with the car, and a twin of the first of these."""
    at = TURN * frame
    return [
        cuboid("parked", beside(0, w.AHEAD), stationary=True),
        cuboid("ahead", beside(at, w.AHEAD), sensor=0, sibling="twin-of-ahead"),
        cuboid("right", beside(at, w.RIGHT), sensor=0),
        cuboid("twin-of-ahead", beside(at + 0.03, w.AHEAD), sensor=1),
    ]


def as_published(rows: list[dict]) -> pd.DataFrame:
    """Return a table whose texts, and names of columns, are objects as in the published files."""
    table = pd.DataFrame(rows, dtype=object).infer_objects()
    texts = table.select_dtypes(["object", "string"]).columns
    table = table.astype(dict.fromkeys(texts, object))
    table.columns = table.columns.astype(object)
    return table


def write_rows(path: Path, rows: list[dict]) -> None:
    w.write_bytes(path, gzip.compress(pickle.dumps(as_published(rows))))


def write(folder: Path, frames=3) -> w.Made:
    ats = TURN * np.arange(frames)
    for camera, azimuth in CAMERAS.items():
        place = folder / "camera" / camera
        for k in range(frames):
            w.write_bytes(place / f"{k:02d}.jpg")
        put(place / "intrinsics.json", {"fx": 50, "fy": 51, "cx": 31.5, "cy": 23.5})
        poses = [w.car_at(at + LAG[camera]) @ w.mounted(azimuth) for at in ats]
        put(place / "poses.json", [placed(pose) for pose in poses])
        put(place / "timestamps.json", list(BEGIN + ats + LAG[camera]))
    for k, at in enumerate(ats):
        x, y, z = w.landmarks().T
        table = pd.DataFrame({"x": x, "y": y, "z": z, "i": 1.0, "t": BEGIN + at - 0.05, "d": 0})
        table.columns = table.columns.astype(object)
        w.write_bytes(folder / f"lidar/{k:02d}.pkl.gz", gzip.compress(pickle.dumps(table)))
        write_rows(folder / CUBOIDS / f"{k:02d}.pkl.gz", cuboids(k))
    put(folder / "lidar/poses.json", [placed(w.car_at(at) @ w.SCANNER) for at in ats])
    put(folder / "lidar/timestamps.json", list(BEGIN + ats))
    # A turn begins at the back; the sweep's stamp is its end.
    return w.Made(
        root=folder,
        photographs=w.shots(CAMERAS, LAG, ats, BEGIN),
        sweeps=list(BEGIN + ats),
        boxes=w.tracks(ats, {"ahead": -0.5 * TURN, "right": -0.25 * TURN}, beside, BEGIN),
        tables=[
            Path(place, f"{name}.json")
            for place in (FRONT, "lidar")
            for name in ("poses", "timestamps")
        ],
        optional=[CUBOIDS / "01.pkl.gz"],
        scans=[Path(f"lidar/{k:02d}.pkl.gz") for k in range(frames)],
    )
