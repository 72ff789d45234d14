"""From a video to a folder of photographs: its frames, their colours, and the choice of frames.

Corners are tracked from frame to frame. Parallax is the part of their motion that no rotation
explains: a rotating camera shows no depth. A frame is due if the camera has moved far enough since
the last chosen frame; the sharpest frame around that time is chosen. So frame rate and speed do not
matter, and a resting camera gives one photograph.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import av
import cv2
import numpy as np
from av.filter import Graph
from av.stream import Disposition
from jaxtyping import Float, Float32, UInt, UInt8

from p2gs_jax.config import DataConfig
from p2gs_jax.core.atomic import write_text
from p2gs_jax.core.numerics import evenly_spaced, srgb_decode
from p2gs_jax.errors import UserError, broken
from p2gs_jax.scene.convert import icc
from p2gs_jax.scene.convert.convert import Converted, cache_of, write_png
from p2gs_jax.scene.convert.readers import made_exif
from p2gs_jax.scene.drone_srt import read_shots, settings_at, srt_beside
from p2gs_jax.scene.files import Report, cached_folder, file_fingerprints

RECORD = "frames.json"
_VERSION = 2  # part of the key of the cached folder, as in `convert`
_TRANSFER_NAMES = {"hlg": "HLG video", "pq": "PQ video"}
_AGAIN = "copy or export the video again"
_SHORT = "film while walking around the object"
VIDEO_SUFFIXES = frozenset(
    {".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi", ".mts", ".m2ts", ".ts", ".3gp"}
    | {".insv", ".360"}
)
# Files of 360-degree cameras, with two fisheye images or six sides of a cube in a frame.
_ALL_ROUND = frozenset({".insv", ".360"})
# Weights of red and blue in luma, by the code of the matrix (ITU-T H.273, table 4).
_BT601 = (0.299, 0.114)
_LUMA = {1: (0.2126, 0.0722), 5: _BT601, 6: _BT601, 7: (0.212, 0.087), 9: (0.2627, 0.0593)}
_FULL_RANGE = 2  # FFmpeg's code
_SMALLEST_HD = 720  # shorter side, pixels: smaller videos use BT.601 if they state no matrix
# Longer side of the frames for tracking, pixels.
LONGER_SIDE = 640
_CORNERS, _FEWEST = 400, 30  # tracked corners: the largest number, and the fewest for a motion
# The usual focal length of video, in longer sides. If it is wrong by a third, a rotation of 10
# degrees looks like parallax of a tenth of its motion.
_FOCAL = 0.85
_BACK = 1.0  # a corner that is tracked back must end this near to its start, pixels
_MID, _CONTRAST = 128.0, 48.0  # mean and deviation of normalised frames, 8-bit levels
_ROUNDS = 4  # of the robust fit of a rotation
# A frame is due at one of these: motion in longer sides, and share of lost corners (BUILD_NOTES).
PARALLAX, DISPLACEMENT, LOST = 0.012, 0.10, 0.5
# A frame is a candidate from this fraction of a threshold on.
_CANDIDATE = 0.6
# The largest number of candidates: the frames of a hovering camera must not fill the memory.
_MOST_CANDIDATES = 48
# If all candidates are blurred, the choice waits up to this multiple of a threshold.
_LATEST = 1.5
# A frame is blurred below this fraction of the sharpness of the last chosen frame.
_BLURRED = 0.7
# The first photograph is chosen among this number of first frames.
_FIRST = 6


@dataclass(frozen=True)
class Frame:
    """A decoded frame."""

    number: int  # from 0 on, in display order
    time: float  # seconds from the first frame
    turn: int  # number of counterclockwise quarter turns that make it upright
    pixel_aspect: float  # ratio of width to height of a pixel
    _decoded: av.VideoFrame

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in square pixels, upright."""
        width, height = round(self._decoded.width * self.pixel_aspect), self._decoded.height
        return (height, width) if self.turn % 2 else (width, height)

    @property
    def transfer(self) -> icc.Transfer | None:
        """The transfer function that gives light; None: the camera's tone curve."""
        return icc.TRANSFERS.get(int(self._decoded.color_trc))

    def grey(self) -> UInt8[np.ndarray, "h w"]:
        """Return a small grey picture, not rotated; its longer side is at most LONGER_SIDE."""
        frame = self._decoded
        scale = min(1.0, LONGER_SIDE / max(frame.width, frame.height))
        # swscale needs even widths.
        size = [max(2, round(n * scale / 2) * 2) for n in (frame.width, frame.height)]
        small = frame.reformat(width=size[0], height=size[1], format="gray")
        return small.to_ndarray()

    def codes(self) -> UInt[np.ndarray, "h w 3"]:
        """Return upright sRGB values, with 16 bits for light, other primaries and deep colour."""
        signal = _signal(self._decoded)
        primaries = icc.PRIMARIES.get(int(self._decoded.color_primaries), icc.BT709)
        if self.transfer is not None:
            light = icc.to_light(signal, self.transfer) @ icc.to_srgb_matrix(primaries).T
            codes = icc.encode_16(light)
        elif primaries is not icc.BT709:
            light = srgb_decode(np.clip(signal, 0, 1)) @ icc.to_srgb_matrix(primaries).T
            codes = icc.encode_16(light)
        else:
            deep = max(c.bits for c in self._decoded.format.components) > 8
            kind = np.uint16 if deep else np.uint8
            codes = np.rint(np.clip(signal, 0, 1) * np.iinfo(kind).max).astype(kind)
        if self.pixel_aspect != 1:
            width = round(codes.shape[1] * self.pixel_aspect)
            method = cv2.INTER_AREA if self.pixel_aspect < 1 else cv2.INTER_LINEAR
            codes = cv2.resize(codes, (width, codes.shape[0]), interpolation=method)
        return np.ascontiguousarray(np.rot90(codes, self.turn))


def frames_of(path: Path) -> Iterator[Frame]:
    """Yield all frames of a video.

    Raises UserError: the file is not a video, has no frame, changes its size, or has only one
    readable frame.
    """
    with _opened(path) as (container, stream):
        stream.thread_type = "AUTO"
        rate = float(stream.average_rate or 30)
        ratio = stream.sample_aspect_ratio
        pixel_aspect = float(ratio) if ratio else 1.0
        first, begin, number = None, 0.0, 0
        try:
            for decoded in _whole_frames(container.decode(stream), stream):
                size = f"{decoded.width}x{decoded.height}"
                time = float(decoded.time) if decoded.time is not None else number / rate
                if first is None:
                    first, begin = size, time
                if size != first:
                    why = f"changes its size: frame {number} is {size}, earlier ones are {first}."
                    raise broken(path, why, "cut it into parts of one size and fit one of them")
                turn = round(decoded.rotation / 90) % 4
                yield Frame(number, time - begin, turn, pixel_aspect, decoded)
                number += 1
        except av.FFmpegError as error:
            # The frames before the fault of a broken file are used, and the caller counts them.
            if number < 2:
                why = f"cannot be decoded: {error.strerror or error}."
                raise broken(path, why, _AGAIN) from None


def _whole_frames(frames: Iterator[av.VideoFrame], stream: Any) -> Iterator[av.VideoFrame]:
    """Yield frames, deinterlaced (bwdif) from the first interlaced one on."""
    graph = None
    for frame in frames:
        if graph is None and frame.interlaced_frame:
            graph = Graph()
            graph.link_nodes(
                graph.add_buffer(template=stream, time_base=stream.time_base),
                graph.add("bwdif", "mode=send_frame:deint=interlaced"),
                graph.add("buffersink"),
            ).configure()
        if graph is None:
            yield frame
            continue
        graph.push(frame)
        yield from _filtered(graph)
    if graph is not None:
        graph.push(None)
        yield from _filtered(graph)


def _filtered(graph: Graph) -> Iterator[av.VideoFrame]:
    with contextlib.suppress(av.BlockingIOError, av.EOFError):
        while True:
            yield cast(av.VideoFrame, graph.pull())


def expected_frames(path: Path) -> int | None:
    """Return the number of frames that the file states, or None."""
    with _opened(path) as (container, stream):
        if stream.frames:
            return int(stream.frames)
        if container.duration and stream.average_rate:
            duration = container.duration
            if "matroska" in container.format.name:  # it counts from 0, not from the first frame
                duration -= container.start_time or 0
            return round(duration / av.time_base * float(stream.average_rate))
    return None


def video_size(path: Path) -> tuple[int, int]:
    """Return (width, height) of the first frame, upright; errors as in `frames_of`."""
    for frame in frames_of(path):
        return frame.size
    raise no_frames(path, 0)


def no_frames(path: Path, count: int) -> UserError:
    """Return the error for a video with `count` frames, 0 or 1."""
    frames = "one frame" if count else "no frame"
    why = f"holds {frames}; a scene needs several from different positions."
    return broken(path, why, _SHORT)


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, Any]]:
    if path.suffix.lower() in _ALL_ROUND or _is_spherical(path):
        why = "is the recording of a 360-degree camera, whose frames are not pinhole images."
        fix = "export a flat (reframed) video of it with the camera's program, and fit that"
        raise broken(path, why, fix)
    try:
        container = av.open(str(path))
    except (av.FFmpegError, OSError) as error:
        why = f"cannot be opened as a video: {error.strerror or error}."
        raise broken(path, why, f"{_AGAIN}, as .mp4 or .mov") from None
    with container:
        # Album covers are video streams of one picture.
        cover = int(Disposition.attached_pic)
        streams = [s for s in container.streams.video if not int(s.disposition) & cover]
        if not streams:
            kinds = sorted({s.type for s in container.streams}) or ["nothing"]
            why = f"holds no video, but {', '.join(kinds)}."
            raise broken(path, why, "name the file that holds the video")
        yield container, streams[0]


def _is_spherical(path: Path) -> bool:
    """Return whether an .mp4 or .mov states that it is spherical (Google's Spherical Video)."""
    with contextlib.suppress(OSError), path.open("rb") as file:
        while len(head := file.read(8)) == 8:
            size, name = int.from_bytes(head[:4]) - 8, head[4:]
            if size == 1 - 8:
                size = int.from_bytes(file.read(8)) - 16
            if size < 0:
                return False
            if name == b"moov":
                metadata = file.read(size)
                return b"GSpherical:Spherical>" in metadata or b"sv3d" in metadata
            file.seek(size, os.SEEK_CUR)
    return False


def _signal(frame: av.VideoFrame) -> Float[np.ndarray, "h w 3"]:
    """Return coded red, green and blue, 0 to 1 for values in range.

    swscale only enlarges the chroma: its conversion to RGB errs by up to 3 of 255 levels.
    """
    if frame.format.is_rgb:
        return frame.reformat(format="rgb48le").to_ndarray().astype(np.float32) / 65535
    full = int(frame.color_range) == _FULL_RANGE or frame.format.name.startswith("yuvj")
    span = 2 if full else 1
    planar = frame.reformat(format="yuv444p16le", src_color_range=span, dst_color_range=span)
    coded = planar.to_ndarray().astype(np.float32) / 256
    y, u, v = np.moveaxis(coded, -1, 0)
    foot, luma, chroma = (0, 255, 255) if full else (16, 219, 224)
    y, u, v = (y - foot) / luma, (u - 128) / chroma, (v - 128) / chroma
    usual = 1 if min(frame.width, frame.height) >= _SMALLEST_HD else 5
    kr, kb = _LUMA.get(int(cast(int, frame.colorspace)), _LUMA[usual])
    red, blue = y + 2 * (1 - kr) * v, y + 2 * (1 - kb) * u
    return np.stack([red, (y - kr * red - kb * blue) / (1 - kr - kb), blue], axis=-1)


def read_video(path: Path, cfg: DataConfig, work_dir: Path | None, report: Report) -> Converted:
    """Return the chosen frames of a video as photographs in `work_dir`, or in the user's cache.

    Raises UserError: as `frames_of` does, or fewer than two frames would be used.
    """
    key = {"version": _VERSION, "file": file_fingerprints([path])}
    key |= {"every": cfg.every, "max_frames": cfg.max_frames}
    if subtitles := srt_beside(path):
        key["subtitles"] = file_fingerprints([subtitles])

    def build(folder: Path) -> None:
        record = _keep(path, cfg, folder, report)
        write_text(folder / RECORD, json.dumps(record, indent=1))

    with cached_folder(cache_of(path, work_dir), "video", key, build) as folder:
        record = json.loads((folder / RECORD).read_text())
    paths = [folder / frame["file"] for frame in record["frames"]]
    originals = {file.name: file for file in paths}
    return Converted(folder, paths, originals, tuple(record["notes"]), record["known"])


def _keep(path: Path, cfg: DataConfig, folder: Path, report: Report) -> dict[str, Any]:
    """Choose frames and write them to `folder`; return their record."""
    expected, seen = expected_frames(path), 0

    def small_frames() -> Iterator[tuple[int, np.ndarray]]:
        nonlocal seen
        for frame in frames_of(path):
            if seen % 100 == 0:
                total = "" if expected is None else f" of {expected}"
                report(f"reading the video: frame {frame.number}{total}")
            seen += 1
            yield frame.number, frame.grey()

    if cfg.every is None:
        found = choose_frames(small_frames())
        rule = "sharp ones, each from a new position"
    else:
        found = [n for n, _ in small_frames() if n % cfg.every == 0]
        rule = "all of them" if cfg.every == 1 else f"one in {cfg.every}"
    if seen < 2:
        raise no_frames(path, seen)
    kept = [found[row] for row in evenly_spaced(len(found), cfg.max_frames)]
    thin = f", thinned from {len(found)} (--max-frames)" if len(kept) < len(found) else ""
    notes = [f"{len(kept)} of {seen} frames of the video are used: {rule}{thin}."]
    if expected is not None and seen < expected - 2:
        notes.append(f"The video breaks off: {seen} of {expected} frames could be decoded.")
    if len(kept) < 2:
        why = f"{len(kept)} of {seen} frames would be used; a scene needs several from "
        fix = f"{_SHORT}, or choose frames by number with --every"
        raise broken(f"{path}:", why + "different positions.", fix)
    subtitles = srt_beside(path)
    shots = [] if subtitles is None else read_shots(subtitles)
    if subtitles is not None:
        where = f"are read from {subtitles.name}" if shots else f"are not in {subtitles.name}"
        notes.append(f"The exposures of the frames {where}.")
    records: list[dict[str, Any]] = []
    transfers: set[str | None] = set()
    for frame in frames_of(path):
        if frame.number not in kept:
            continue
        if len(records) % 10 == 0:
            report(f"writing frames: {len(records)} of {len(kept)}")
        name = f"{frame.number:06d}.png"
        exif = made_exif(settings_at(shots, frame.time)) if shots else None
        write_png(folder / name, frame.codes(), exif)
        transfers.add(frame.transfer)
        records.append({"file": name, "frame": frame.number, "time": round(frame.time, 6)})
        if len(records) == len(kept):
            break
    if len(transfers) > 1 and None in transfers:
        notes.append("The transfer function changes within the video: its curve is not known.")
    known = None if None in transfers else ", ".join(_TRANSFER_NAMES[t] for t in sorted(transfers))  # type: ignore[index, type-var]
    return {"known": known, "notes": notes, "frames": records}


def normalised(grey: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w"]:
    """Return a frame with fixed mean and contrast, so that exposure does not look like motion."""
    values = grey.astype(np.float32)
    gain = _CONTRAST / max(float(values.std()), 1.0)
    return np.clip((values - values.mean()) * gain + _MID, 0, 255).astype(np.uint8)


class Tracker:
    """Tracks corners of a normalised reference frame."""

    def __init__(self, grey: UInt8[np.ndarray, "h w"]):
        corners = cv2.goodFeaturesToTrack(grey, _CORNERS, 0.01, 7)
        self._start = np.zeros((0, 2), np.float32) if corners is None else corners[:, 0]
        self._now, self._last = self._start, grey
        self._count = max(len(self._start), 1)

    def follow(self, grey: UInt8[np.ndarray, "h w"]) -> float:
        """Return motion / threshold of the next frame, normalised like the reference (1: due)."""
        if len(self._now) >= _FEWEST:
            ahead, found, _ = cv2.calcOpticalFlowPyrLK(
                self._last, grey, self._now, np.empty_like(self._now)
            )
            back, found_back, _ = cv2.calcOpticalFlowPyrLK(
                grey, self._last, ahead, np.empty_like(ahead)
            )
            error = np.linalg.norm(back - self._now, axis=1)
            good = (found[:, 0] == 1) & (found_back[:, 0] == 1) & (error < _BACK)
            height, width = grey.shape
            good &= ((ahead >= 0) & (ahead < [width, height])).all(1)
            self._start, self._now = self._start[good], ahead[good]
        self._last = grey
        if len(self._now) < _FEWEST:
            return math.inf
        side = max(grey.shape)
        displacement = float(np.median(np.linalg.norm(self._now - self._start, axis=1))) / side
        parallax = _parallax(self._start, self._now, grey.shape)
        lost = 1 - len(self._now) / self._count
        return max(parallax / PARALLAX, displacement / DISPLACEMENT, lost / LOST)


def _parallax(
    start: Float32[np.ndarray, "n 2"], now: Float32[np.ndarray, "n 2"], shape: tuple[int, ...]
) -> float:
    """Return the upper quartile of displacements after the best rotation, in longer sides."""
    side = max(shape)
    focal = _FOCAL * side
    middle = np.array([shape[1] / 2, shape[0] / 2])

    def rays(points: np.ndarray) -> np.ndarray:
        rays = np.concatenate([points - middle, np.full((len(points), 1), focal)], axis=1)
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)

    a, b = rays(start), rays(now)
    use = np.ones(len(a), bool)
    rest = np.zeros(len(a))
    for _ in range(_ROUNDS):
        u, _, vt = np.linalg.svd(b[use].T @ a[use])
        rotation = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
        turned = a @ rotation.T
        predicted = turned[:, :2] / np.maximum(turned[:, 2:], 1e-3) * focal + middle
        rest = np.linalg.norm(predicted - now, axis=1) / side
        use = rest <= max(2 * float(np.median(rest)), 1e-4)
    return float(np.percentile(rest, 75))


def choose_frames(frames: Iterable[tuple[int, UInt8[np.ndarray, "h w"]]]) -> list[int]:
    """Return the numbers of the chosen frames, in order, from numbers and small grey pictures."""
    chosen: list[tuple[float, int]] = []
    tracker: Tracker | None = None
    # A candidate has a sharpness, a number and a picture.
    waiting: list[tuple[float, int, UInt8[np.ndarray, "h w"]]] = []

    def choose() -> Tracker:
        """Choose the sharpest candidate; track from it to the newest frame."""
        best = max(range(len(waiting)), key=lambda k: waiting[k][0])
        (sharp, number, grey), later = waiting[best], waiting[best + 1 :]
        chosen.append((sharp, number))
        waiting.clear()
        started = Tracker(grey)
        for candidate in later:
            consider(started, *candidate)
        return started

    def consider(tracker: Tracker, sharp: float, number: int, grey: np.ndarray) -> float:
        """Return motion / threshold of a frame (1: one is due); it may become a candidate."""
        share = tracker.follow(grey)
        if share >= _CANDIDATE:
            waiting.append((sharp, number, grey))
        return share

    for number, grey in frames:
        grey = normalised(grey)
        # The variance of the Laplacian measures the finest details.
        sharp = float(cv2.Laplacian(grey, cv2.CV_32F).var())
        if tracker is None:
            waiting.append((sharp, number, grey))
            if len(waiting) == _FIRST:
                tracker = choose()
            continue
        share = consider(tracker, sharp, number, grey)
        due = share >= 1 and max(sharp for sharp, *_ in waiting) >= _BLURRED * chosen[-1][0]
        if due or share >= _LATEST or len(waiting) >= _MOST_CANDIDATES:
            tracker = choose()
    if waiting:
        choose()
    return [number for _, number in chosen]
