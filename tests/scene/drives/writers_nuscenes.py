"""nuScenes: tables by the published schema, with a sweep and a photograph between keyframes."""

import json
from pathlib import Path

import numpy as np
from scene.drives import writers as w

START = 1532402927647951  # microseconds
TABLES = Path("v1.0-mini")
CAMERAS = {"CAM_FRONT": 0.0, "CAM_BACK_LEFT": 1.9}
LAG = {"CAM_FRONT": -0.035, "CAM_BACK_LEFT": -0.001}
K = [[50.0, 0, 31.5], [0, 51, 23.5], [0, 0, 1]]
TURN = 0.05  # seconds of a scanner's turn


def placed(pose) -> dict:
    return {"translation": pose[:3, 3].tolist(), "rotation": w.wxyz(pose)}


def calibrated(channel, pose, K) -> dict:
    token = {"token": f"calibrated {channel}", "sensor_token": channel}
    return {**token, **placed(pose), "camera_intrinsic": K}


def recorded(root, sample, scene, channel, seconds, key) -> tuple[dict, dict]:
    """Write a file, and return its rows of sample_data and ego_pose."""
    stamp = START + round(seconds * 1e6)
    camera = channel.startswith("CAM")
    folder, ending = "samples" if key else "sweeps", "jpg" if camera else "pcd.bin"
    name = f"{folder}/{channel}/{scene}__{channel}__{stamp}.{ending}"
    ego = w.car_at(seconds)
    if channel == "LIDAR_TOP":
        local = w.applied(w.inv(ego @ w.SCANNER), w.landmarks())
        data = np.column_stack([local, np.zeros((len(local), 2))]).astype("<f4").tobytes()
        w.write_bytes(root / name, data)
    else:
        w.write_bytes(root / name)
    token = f"{scene} {channel} {stamp}"
    row = {
        "token": token,
        "sample_token": sample,
        "ego_pose_token": token,
        "calibrated_sensor_token": f"calibrated {channel}",
        "timestamp": stamp,
        "filename": name,
        "is_key_frame": key,
        "width": w.WIDTH if camera else 0,
        "height": w.HEIGHT if camera else 0,
    }
    return row, {"token": token, "timestamp": stamp, **placed(ego)}


def boxed(scene, sample, instance, pose, attribute) -> dict:
    return {
        "token": f"{sample} {instance}",
        "sample_token": sample,
        "instance_token": f"{scene} {instance}",
        "attribute_tokens": [attribute],
        **placed(pose),
        "size": [w.BREADTH, w.LENGTH, w.TALL],
    }


def write(root: Path, frames=3, scenes=("scene-0001",), version=TABLES) -> w.Made:
    names = "scene sample sample_data ego_pose sample_annotation instance category attribute"
    tables: dict[str, list] = {name: [] for name in names.split()}
    kinds = {**dict.fromkeys(CAMERAS, "camera"), "LIDAR_TOP": "lidar", "RADAR": "radar"}
    tables["sensor"] = [{"token": c, "channel": c, "modality": kinds[c]} for c in kinds]
    tables["calibrated_sensor"] = [
        *(calibrated(channel, w.mounted(azimuth), K) for channel, azimuth in CAMERAS.items()),
        calibrated("LIDAR_TOP", w.SCANNER, []),
        calibrated("RADAR", np.eye(4), []),
    ]
    tables["category"].append({"token": "car", "name": "vehicle.car"})
    states = {"moving": "vehicle.moving", "parked": "vehicle.parked", "rider": "cycle.with_rider"}
    tables["attribute"] = [{"token": token, "name": name} for token, name in states.items()]
    for scene in scenes:
        tables["scene"].append({"token": f"scene {scene}", "name": scene, "nbr_samples": frames})
        for moment in reversed(range(frames)):
            sample, at = f"{scene} sample {moment}", 0.5 * moment
            row = {"token": sample, "scene_token": f"scene {scene}"}
            tables["sample"].append({**row, "timestamp": START + round(at * 1e6)})
            data = [(c, at + LAG[c], True) for c in CAMERAS]
            data += [("LIDAR_TOP", at, True), ("LIDAR_TOP", at - TURN, False)]
            data += [("RADAR", at, True), ("CAM_FRONT", at - 0.1, False)]
            for channel, when, key in data:
                row, pose = recorded(root, sample, scene, channel, when, key)
                tables["sample_data"].append(row)
                tables["ego_pose"].append(pose)
            starts = "moving" if moment else "parked"
            tables["sample_annotation"] += [
                boxed(scene, sample, "ahead", w.beside(at, w.AHEAD), "rider"),
                boxed(scene, sample, "right", w.beside(at, w.RIGHT), starts),
                boxed(scene, sample, "parked", w.beside(0, w.AHEAD), "parked"),
            ]
        for instance in ("ahead", "right", "parked"):
            tables["instance"].append({"token": f"{scene} {instance}", "category_token": "car"})
    for name, rows in tables.items():
        w.write_bytes(root / version / f"{name}.json", json.dumps(rows, indent=1).encode())
    ats = 0.5 * np.arange(frames)
    # The turn begins at the scanner's left; a sweep's stamp is its end.
    return w.Made(
        root=root,
        photographs=w.shots(CAMERAS, LAG, ats),
        sweeps=[t for at in ats for t in (at - TURN, at)],
        boxes=w.tracks(ats, {"ahead": -0.75 * TURN, "right": -0.5 * TURN}, w.beside),
        tables=[
            version / f"{name}.json"
            for name in ("scene", "sample", "ego_pose", "sensor", "calibrated_sensor")
        ],
        optional=[version / "sample_annotation.json"],
        scans=sorted(p.relative_to(root) for p in root.glob("s*/LIDAR_TOP/*")),
    )
