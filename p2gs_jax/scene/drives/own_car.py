"""The car itself in the photographs of its cameras, found once a camera and kept as a picture."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from p2gs_jax.core.atomic import atomic_write
from p2gs_jax.scene.cache import cached_folder
from p2gs_jax.scene.drives.recording import Photograph, Recording, RigCamera
from p2gs_jax.scene.drives.unmoving import FEWEST, WIDTH, cut, expected_motion, often_apart, weigh
from p2gs_jax.scene.files import decode_grey, undecodable
from p2gs_jax.scene.lens import scale_intrinsics
from p2gs_jax.scene.rigid import inverse, up_of_drive

# Photographs of a camera that are looked at, spread evenly over its way; fewer say too little.
MOST_LOOKED_AT, FEWEST_LOOKED_AT = 24, 6
# A turn by one radian counts as this way, metres.
TURN_AS_WAY = 10.0
# Part of results that are kept: raise it with every change of what is found.
_VERSION = 1
_SAID = "own car"


class OwnCar(NamedTuple):
    """The car itself in one camera.

    Attributes:
        mask: where it is, in the photograph as stored, at a lower resolution; None: nowhere.
        looked_at: photographs; 0 where the camera hardly moves and nothing can be told.
    """

    mask: Bool[np.ndarray, "h w"] | None
    looked_at: int


def find_own_cars(
    recording: Recording,
    names: Sequence[str],
    work_dir: Path | None = None,
    report: Callable[[str], None] = lambda message: None,
) -> tuple[dict[str, Bool[np.ndarray, "h w"]], list[str]]:
    """Return where cameras see their own car, and what to say of it.

    All photographs of the drive serve, whatever frames are used.

    Args:
        recording: from a reader.
        names: of the cameras.
        work_dir: pictures of the results are kept here for a resume; None keeps nothing.
        report: receives progress.
    """
    cameras = {c.name: c for c in recording.cameras}
    poses = np.stack([p.pose for p in recording.photographs])
    up = up_of_drive(inverse(poses), [p.camera for p in recording.photographs])
    report("Looking for the car itself in the photographs")
    masks: dict[str, Bool[np.ndarray, "h w"]] = {}
    standing, without = [], []
    for name in names:
        taken = [p for p in recording.photographs if p.camera == name and _is_there(p)]
        taken = spread_over_the_way(sorted(taken, key=lambda p: p.frame), MOST_LOOKED_AT)
        found = _kept(cameras[name], taken, up, work_dir)
        if found.mask is not None:
            masks[name] = found.mask
        else:
            (without if found.looked_at else standing).append(name)
    said = [f"{name} {mask.mean():.1%}" for name, mask in masks.items()]
    notes = [f"{_SAID}: {', '.join(said)} of the picture, left out of the fit"] if said else []
    if without:
        notes.append(f"{_SAID}: not seen by {', '.join(without)}")
    if standing:
        notes.append(
            f"{_SAID}: {', '.join(standing)} took too few photographs, or hardly moved, so "
            "nothing can be told from them; give masks if they show it"
        )
    return masks, notes


def find_own_car(
    camera: RigCamera,
    pictures: UInt8[np.ndarray, "n h w"],
    poses: Float[np.ndarray, "n 4 4"],
    up: Float[np.ndarray, " 3"],
) -> OwnCar:
    """Return where a camera sees its own car.

    Args:
        camera: its lens.
        pictures: grey, at `WIDTH`, in the order of the drive.
        poses: camera to world of each.
        up: away from the road, of length 1.
    """
    if len(pictures) < FEWEST_LOOKED_AT:
        return OwnCar(None, 0)
    height = pictures.shape[1]
    K = scale_intrinsics(camera.K, WIDTH / camera.width, height / camera.height)
    motion = expected_motion(poses, up, K, camera.distortion, WIDTH, height)
    if often_apart(motion).max() < FEWEST:
        return OwnCar(None, 0)
    mask = cut(weigh(pictures, motion))
    return OwnCar(mask if mask.any() else None, len(pictures))


def spread_over_the_way(photographs: Sequence[Photograph], most: int) -> list[Photograph]:
    """Return photographs evenly spread over a camera's way, not over time: cars wait.

    Args:
        photographs: of one camera, in the order of time.
        most: that are returned.
    """
    if len(photographs) < 2:
        return list(photographs)
    poses = np.stack([p.pose for p in photographs])
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    turned = np.einsum("nij,nij->n", poses[1:, :3, :3], poses[:-1, :3, :3])
    steps += TURN_AS_WAY * np.arccos(np.clip((turned - 1) / 2, -1, 1))
    way = np.concatenate([[0.0], np.cumsum(steps)])
    stops = np.linspace(0, way[-1], most)
    rows = sorted({int(np.abs(way - stop).argmin()) for stop in stops})
    return [photographs[row] for row in rows]


def _is_there(photograph: Photograph) -> bool:
    return photograph.embedded is not None or photograph.path.is_file()


def _kept(
    camera: RigCamera,
    photographs: Sequence[Photograph],
    up: Float[np.ndarray, " 3"],
    work_dir: Path | None,
) -> OwnCar:
    """Return where a camera sees its car, from an earlier run if that found it."""

    def build(folder: Path) -> None:
        pictures = np.array([_picture(p, camera) for p in photographs])
        poses = np.array([p.pose for p in photographs]).reshape(-1, 4, 4)
        result = find_own_car(camera, pictures, poses, up)
        if result.mask is not None:
            with atomic_write(folder / "car.png") as temporary:
                cv2.imwrite(str(temporary), result.mask.astype(np.uint8) * 255)
        (folder / "looked_at").write_text(str(result.looked_at))

    stamps = [
        (p.path.name, p.frame, 0 if p.embedded else p.path.stat().st_mtime_ns) for p in photographs
    ]
    places = [np.round(p.pose, 6).tolist() for p in photographs]
    key = [_VERSION, camera.name, camera.K.tolist(), stamps, places]
    with cached_folder(work_dir, f"own_car/{camera.name}", key, build) as folder:
        looked_at = int((folder / "looked_at").read_text())
        if not (folder / "car.png").is_file():
            return OwnCar(None, looked_at)
        picture = cv2.imread(str(folder / "car.png"), cv2.IMREAD_GRAYSCALE)
    return OwnCar(np.asarray(picture) > 0, looked_at)


def _picture(photograph: Photograph, camera: RigCamera) -> UInt8[np.ndarray, "h w"]:
    """Return a photograph in grey at `WIDTH`.

    Raises:
        UserError: its file is broken.
    """
    data = photograph.embedded() if photograph.embedded else photograph.path.read_bytes()
    picture = decode_grey(data, camera.width // WIDTH)
    if picture is None:
        raise undecodable(photograph.path)
    height = max(1, round(picture.shape[0] * WIDTH / picture.shape[1]))
    return cv2.resize(picture, (WIDTH, height), interpolation=cv2.INTER_AREA)
