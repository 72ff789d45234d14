"""The ego mask: the car in the photographs of its cameras, found once for each camera and cached.

Pixels of the car never change while it drives. An edge that stays is evidence for the car only if
the world would have moved at its pixel. The least motion is that of the farthest visible surface,
the road; above the horizon no motion is expected. Motion counts across an edge, not along it: a
lane marking parallel to the car stays too. An edge that changes is evidence for the world. Smooth
bonnets, sky and asphalt have no edges and count like the pixels around them: the mask is a minimal
cut through the pixels, cheap along edges that stay. Gradients are of logarithms, so exposure does
not matter.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8
from scipy.sparse import coo_array, csr_matrix
from scipy.sparse.csgraph import breadth_first_order, maximum_flow

from p2gs_jax.core.atomic import atomic_write
from p2gs_jax.scene.drives.recording import Photograph, Recording, RigCamera
from p2gs_jax.scene.files import Report, cached_folder, decode_grey, undecodable
from p2gs_jax.scene.lens import scale_intrinsics, undistort_points
from p2gs_jax.scene.rigid import inverse, up_of_drive
from p2gs_jax.types import Distortion

# The most photographs of a camera that are used, and the fewest that suffice.
MOST_LOOKED_AT, FEWEST_LOOKED_AT = 24, 6
# A turn by 1 radian counts like this distance, metres.
TURN_AS_DISTANCE = 10.0
# The version is part of the key of cached results: raise it whenever results change.
_VERSION = 2
_NOTE = "ego mask"
# Lengths and thresholds in pictures are in pixels at this width (BUILD_NOTES, "The car itself").
WIDTH = 480
# Display values below `DARK` are noise; `BLUR` is the blur before gradients, pixels.
DARK, BLUR = 0.02, 1.0
# An edge stays if its gradient (of logarithms, per pixel) is at least `LEAST_GRADIENT` in 80 % of
# the frames, and there at least 0.5 times the gradient of the strongest 20 %.
LEAST_GRADIENT, STEADY = 0.012, (20, 80, 0.5)
# The largest height of the camera above the road, and the largest distance of the road, metres.
HIGHEST_CAMERA, FARTHEST = 2.5, 1e4
# The world counts as moved after `APART` pixels. An edge that stays is evidence once this happened
# more than `FEWEST` times, full evidence after `ENOUGH` times. Motion along an edge, within an
# angle of sine `ALONG`, does not count.
APART, FEWEST, ENOUGH, ALONG = 3.0, 1.5, 5.5, 0.1
# Weights of the cut: evidence for the car, length of the outline, its least share on edges, area.
CAR, OUTLINE, THROUGH_EDGES, AREA = 3.0, 2.0, 0.02, 0.004
# Changes of a gradient at which evidence for the world begins, and at which it is full.
CHANGE = (0.006, 0.018)
# A part of the mask needs this width (pixels), this share of its outline on edges that stay, this
# much evidence per pixel of outline, and this share of the picture. Gaps up to `GAP` are closed.
NARROWEST, EDGE_SHARE, EDGE_EVIDENCE, LEAST_SHARE, GAP = 7, 0.5, 0.3, 0.002, 13
_MOTION_STEP = 8  # spacing of computed motions, pixels
_CAPACITY = 1000  # integer units of flow for a price of 1


def find_ego_masks(
    recording: Recording, names: Sequence[str], work_dir: Path | None, report: Report
) -> tuple[dict[str, Bool[np.ndarray, "_ _"]], list[str]]:
    """Return the ego masks of the named cameras that see their car, and notes.

    Masks are in the geometry of the stored photographs, at a lower resolution. All photographs of
    the drive are used, whatever frames are chosen. Masks are cached as pictures below `work_dir`
    for a resume; None caches nothing.
    """
    cameras = {c.name: c for c in recording.cameras}
    poses = np.stack([p.pose for p in recording.photographs])
    up = up_of_drive(inverse(poses), [p.camera for p in recording.photographs])
    report("Finding the car in its photographs")
    masks: dict[str, Bool[np.ndarray, "_ _"]] = {}
    undecided, unseen = [], []
    for name in names:
        photographs = [p for p in recording.photographs if p.camera == name]
        existing = [p for p in photographs if p.embedded is not None or p.path.is_file()]
        spread = spread_over_distance(sorted(existing, key=lambda p: p.frame))
        mask = _cached_mask(cameras[name], spread, up, work_dir)
        if mask is None:
            undecided.append(name)
        elif mask.any():
            masks[name] = mask
        else:
            unseen.append(name)
    shares = [f"{name} {mask.mean():.1%}" for name, mask in masks.items()]
    notes = [f"{_NOTE}: {', '.join(shares)} of the picture, left out of the fit"] if shares else []
    if unseen:
        notes.append(f"{_NOTE}: not seen by {', '.join(unseen)}")
    if undecided:
        notes.append(
            f"{_NOTE}: not found for {', '.join(undecided)}, because of too few photographs or "
            "hardly any motion; add masks if the car is visible"
        )
    return masks, notes


def _cached_mask(
    camera: RigCamera, shots: Sequence[Photograph], up: np.ndarray, work_dir: Path | None
) -> Bool[np.ndarray, "h w"] | None:
    """Return the ego mask of a camera, or that of an earlier run; None: it cannot be found."""

    def build(folder: Path) -> None:
        pictures = np.array([_picture(p, camera) for p in shots])
        poses = np.array([p.pose for p in shots]).reshape(-1, 4, 4)
        mask = find_ego_mask(camera, pictures, poses, up)
        if mask is not None:
            _, data = cv2.imencode(".png", mask.astype(np.uint8) * 255)
            with atomic_write(folder / "car.png") as temporary:
                temporary.write_bytes(data.tobytes())

    stamps = [(p.path.name, p.frame, 0 if p.embedded else p.path.stat().st_mtime_ns) for p in shots]
    places = [np.round(p.pose, 6).tolist() for p in shots]
    lens = [camera.K.tolist(), repr(camera.distortion), np.round(up, 6).tolist()]
    key = [_VERSION, camera.name, lens, stamps, places]
    with cached_folder(work_dir, f"ego_mask/{camera.name}", key, build) as folder:
        if not (folder / "car.png").is_file():
            return None
        picture = cv2.imread(str(folder / "car.png"), cv2.IMREAD_GRAYSCALE)
    return np.asarray(picture) > 0


def _picture(photograph: Photograph, camera: RigCamera) -> UInt8[np.ndarray, "h w"]:
    """Return a photograph in grey at `WIDTH`; UserError: its file is broken."""
    data = photograph.embedded() if photograph.embedded else photograph.path.read_bytes()
    picture = decode_grey(data, camera.width // WIDTH)
    if picture is None:
        raise undecodable(photograph.path)
    height = max(1, round(picture.shape[0] * WIDTH / picture.shape[1]))
    return cv2.resize(picture, (WIDTH, height), interpolation=cv2.INTER_AREA)


def spread_over_distance(photographs: Sequence[Photograph]) -> list[Photograph]:
    """Return at most `MOST_LOOKED_AT` photographs of one camera, given in the order of time.

    They are spread evenly over the distance, not over time: cars wait.
    """
    if len(photographs) < 2:
        return list(photographs)
    poses = np.stack([p.pose for p in photographs])
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    turned = np.einsum("nij,nij->n", poses[1:, :3, :3], poses[:-1, :3, :3])
    steps += TURN_AS_DISTANCE * np.arccos(np.clip((turned - 1) / 2, -1, 1))
    distance = np.concatenate([[0.0], np.cumsum(steps)])
    stops = np.linspace(0, distance[-1], MOST_LOOKED_AT)
    rows = sorted({int(np.abs(distance - stop).argmin()) for stop in stops})
    return [photographs[row] for row in rows]


def find_ego_mask(
    camera: RigCamera,
    pictures: UInt8[np.ndarray, "n h w"],
    poses: Float[np.ndarray, "n 4 4"],
    up: Float[np.ndarray, " 3"],
) -> Bool[np.ndarray, "h w"] | None:
    """Return the ego mask of a camera; None: the camera hardly moves.

    Pictures are grey, `WIDTH` pixels wide and in the order of the drive; poses are camera to world;
    `up` is a unit vector away from the road.
    """
    if len(pictures) < FEWEST_LOOKED_AT:
        return None
    height = pictures.shape[1]
    K = scale_intrinsics(camera.K, WIDTH / camera.width, height / camera.height)
    motion = expected_motion(poses, up, K, camera.distortion, height)
    # The sum counts how often the world has moved at each pixel.
    if np.minimum(np.linalg.norm(motion, axis=-1) / APART, 1).sum(0).max() < FEWEST:
        return None
    return cut(weigh(pictures, motion))


class Evidence(NamedTuple):
    """Evidence at every pixel from all frames."""

    stays: Bool[np.ndarray, "h w"]  # an edge is there in nearly all frames
    strength: Float32[np.ndarray, "h w"]  # gradient of this edge, natural logarithms per pixel
    car: Float32[np.ndarray, "h w"]  # evidence for the car, 0 to 1
    change: Float32[np.ndarray, "h w"]  # median change of the gradient


def expected_motion(
    poses: Float[np.ndarray, "n 4 4"],
    up: Float[np.ndarray, " 3"],
    K: Float[np.ndarray, "3 3"],
    distortion: Distortion | None,
    height: int,
) -> Float32[np.ndarray, "n-1 h w 2"]:
    """Return the motion of the farthest visible surface between frames, pixels.

    Poses are camera to world, in the order of the frames; `up` is a unit vector away from the road;
    K is in pixels of the undistorted image, which has `WIDTH` columns and `height` rows.
    """
    columns = np.arange(_MOTION_STEP / 2, WIDTH, _MOTION_STEP)
    rows = np.arange(_MOTION_STEP / 2, height, _MOTION_STEP)
    xs, ys = np.meshgrid(columns, rows)
    straight = undistort_points(np.stack([xs, ys], -1).reshape(-1, 2), K, distortion)
    straight = straight.reshape(*xs.shape, 2).astype(np.float64)
    # The derivative of undistorted pixels by pixels of the photograph.
    jacobian = np.stack([np.gradient(straight, _MOTION_STEP, axis=k) for k in (1, 0)], -1)
    valid = np.isfinite(jacobian).all((-2, -1)) & (np.linalg.det(jacobian) > 1e-3)
    jacobian[~valid] = np.eye(2)
    back = np.linalg.inv(jacobian)
    focal, centre = K[[0, 1], [0, 1]], K[:2, 2]
    rays = np.concatenate([(straight - centre) / focal, np.ones((*xs.shape, 1))], -1)
    out = []
    for pose, next_pose in pairwise(poses):
        towards = rays @ pose[:3, :3].T
        drop = np.maximum(-(towards @ up), HIGHEST_CAMERA / FARTHEST)
        distance = HIGHEST_CAMERA / drop
        points = pose[:3, 3] + towards * distance[..., None]
        local = (points - next_pose[:3, 3]) @ next_pose[:3, :3]
        # Points behind the other camera are far outside its image.
        z = np.maximum(local[..., 2:], 0.05 * distance[..., None])
        moved = local[..., :2] / z * focal + centre - straight
        moved = np.einsum("hwij,hwj->hwi", back, moved)
        moved[~valid] = 0
        out.append(cv2.resize(moved.astype(np.float32), (WIDTH, height)))
    return np.array(out)


def weigh(frames: UInt8[np.ndarray, "n h w"], motion: Float32[np.ndarray, "m h w 2"]) -> Evidence:
    """Return the evidence in grey pictures and the `expected_motion` between them."""
    gradients = np.array([_gradient(picture) for picture in frames])
    usual = np.median(gradients, axis=0)
    across = usual / np.maximum(np.linalg.norm(usual, axis=-1, keepdims=True), 1e-6)
    low, high, share = STEADY
    least, most = np.percentile((gradients * across).sum(-1), (low, high), axis=0)
    stays = (least > LEAST_GRADIENT) & (least > share * most)
    away = np.abs((motion * across).sum(-1)) - ALONG * np.linalg.norm(motion, axis=-1)
    apart = np.clip(away / APART, 0, 1).sum(0)
    evidence = np.clip((apart - FEWEST) / (ENOUGH - FEWEST), 0, 1)
    change = np.sqrt(np.median(((gradients - usual) ** 2).sum(-1), axis=0))
    return Evidence(stays, np.where(stays, least, 0), np.where(stays, evidence, 0), change)


def _gradient(picture: UInt8[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w 2"]:
    """Return the gradient of the natural logarithm, per pixel."""
    logs = cv2.GaussianBlur(np.log(picture.astype(np.float32) / 255 + DARK), (0, 0), BLUR)
    sides = [cv2.Sobel(logs, cv2.CV_32F, dx, 1 - dx, ksize=3, scale=1 / 8) for dx in (1, 0)]
    return np.stack(sides, -1)


def cut(evidence: Evidence) -> Bool[np.ndarray, "h w"]:
    """Return the parts of a picture that never move and touch its border, without small gaps."""
    least, most = CHANGE
    moves = np.clip((evidence.change - least) / (most - least), 0, 1)
    gain = CAR * evidence.car - np.where(evidence.stays, 0, moves) - AREA
    passage = np.exp(-((evidence.strength / (2 * LEAST_GRADIENT)) ** 2))
    return _solid_parts(_minimal_cut(gain, passage), evidence)


def _minimal_cut(gain: np.ndarray, passage: np.ndarray) -> Bool[np.ndarray, "h w"]:
    """Return the pixels with the largest gain minus the price of their outline.

    The border of the picture costs nothing. `passage` is the share of the full price for an outline
    through a pixel.
    """
    h, w = gain.shape
    count = h * w
    rows = np.arange(count).reshape(h, w)
    starts, ends, prices = [], [], []
    neighbours = ((0, 1, 1.0), (1, 0, 1.0), (1, 1, np.sqrt(0.5)), (1, -1, np.sqrt(0.5)))
    for dy, dx, price in neighbours:
        first = np.s_[: h - dy, max(0, -dx) : w - max(0, dx)]
        second = np.s_[dy:, max(0, dx) : w + min(0, dx)]
        cost = np.maximum(np.maximum(passage[first], passage[second]), THROUGH_EDGES)
        a, b, c = rows[first].ravel(), rows[second].ravel(), (OUTLINE / 2 * price * cost).ravel()
        starts += [a, b]
        ends += [b, a]
        prices += [c, c]
    source, sink = count, count + 1
    flat = gain.ravel()
    starts += [np.full(count, source), rows.ravel()]
    ends += [rows.ravel(), np.full(count, sink)]
    prices += [np.maximum(flat, 0), np.maximum(-flat, 0)]
    capacity = np.rint(np.concatenate(prices) * _CAPACITY).astype(np.int32)
    where = (np.concatenate(starts).astype(np.int32), np.concatenate(ends).astype(np.int32))
    graph = csr_matrix(coo_array((capacity, where), shape=(count + 2, count + 2)))
    left = graph - maximum_flow(graph, source, sink).flow
    left.data[left.data < 0] = 0
    left.eliminate_zeros()
    inside = np.zeros(count + 2, bool)
    inside[breadth_first_order(left, source, return_predecessors=False)] = True
    return inside[:count].reshape(h, w)


def _solid_parts(found: Bool[np.ndarray, "h w"], evidence: Evidence) -> Bool[np.ndarray, "h w"]:
    """Return parts that are wide, touch the border, and end within 2 pixels of edges that stay."""
    opened = _morphology(found, cv2.MORPH_OPEN, NARROWEST)
    count, parts = cv2.connectedComponents(opened.astype(np.uint8), connectivity=4)
    near = cv2.dilate(evidence.stays.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    kept = np.zeros_like(found)
    for number in range(1, count):  # 0 numbers the other pixels
        part = parts == number
        at_border = part[[0, -1]].any() or part[:, [0, -1]].any()
        if not at_border or part.mean() < LEAST_SHARE:
            continue
        inner = cv2.erode(part.astype(np.uint8), np.ones((3, 3), np.uint8))
        rim = part & (inner == 0)
        length = max(int(rim.sum()), 1)
        if near[rim].sum() < EDGE_SHARE * length:
            continue
        if evidence.car[part].sum() >= EDGE_EVIDENCE * length:
            kept |= part
    closed = _morphology(kept, cv2.MORPH_CLOSE, GAP)
    # Holes are filled, even those that only the lower border closes.
    _, holes = cv2.connectedComponents((~closed).astype(np.uint8), connectivity=4)
    around = np.unique(np.concatenate([holes[0], holes[:, 0], holes[:, -1]]))
    return ~np.isin(holes, around[around > 0])


def _morphology(mask: Bool[np.ndarray, "h w"], kind: int, side: int) -> Bool[np.ndarray, "h w"]:
    """Open or close by a disc; pixels beyond the border repeat those at the border."""
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    padded = np.pad(mask.astype(np.uint8), 2 * side, mode="edge")
    done = cv2.morphologyEx(padded, kind, disc)[2 * side : -2 * side, 2 * side : -2 * side]
    return done > 0
