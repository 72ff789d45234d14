"""From a video to a folder of photographs: its frames and their colours, and what is kept."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import av
import cv2
import numpy as np
from av.stream import Disposition
from jaxtyping import Float, UInt, UInt8

from p2gs_jax.config import DataConfig
from p2gs_jax.core.atomic import write_text
from p2gs_jax.core.numerics import srgb_decode
from p2gs_jax.errors import UserError, broken
from p2gs_jax.scene.cache import Report, cached_folder, file_fingerprints
from p2gs_jax.scene.convert import icc
from p2gs_jax.scene.convert.convert import Converted, cache_of, write_png
from p2gs_jax.scene.motion import WIDTH, Chosen, choose_frames, thinned

RECORD = "frames.json"
_VERSION = 1
_TRANSFER_NAMES = {"hlg": "HLG video", "pq": "PQ video"}
_AGAIN = "copy or export the video again"
_SHORT = "film while walking around the thing"
VIDEO_SUFFIXES = frozenset(
    {".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi", ".mts", ".m2ts", ".ts", ".3gp", ".insv"}
)
_BT601 = (0.299, 0.114)
# Weights of red and blue in luma, by matrix.
_LUMA = {1: (0.2126, 0.0722), 5: _BT601, 6: _BT601, 7: (0.212, 0.087), 9: (0.2627, 0.0593)}
_FULL_RANGE = 2
_SMALLEST_HD = 720


@dataclass(frozen=True)
class Frame:
    """A decoded frame, `turn` quarter turns against the clock from upright.

    Numbers count from 0 in the order in which frames are shown, `time` is seconds from the
    beginning, and `square` the width over height of a pixel.
    """

    number: int
    time: float
    turn: int
    square: float
    _decoded: av.VideoFrame

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in square pixels, upright."""
        width, height = round(self._decoded.width * self.square), self._decoded.height
        return (height, width) if self.turn % 2 else (width, height)

    @property
    def transfer(self) -> icc.Transfer | None:
        """Transfer function, where it is one that gives light; None: a camera's own curve."""
        return icc.TRANSFERS.get(int(self._decoded.color_trc))

    def grey(self, width: int) -> UInt8[np.ndarray, "h w"]:
        """Return it small and grey, not turned; its longer side has at most `width` pixels."""
        frame = self._decoded
        scale = min(1.0, width / max(frame.width, frame.height))
        # swscale wants even widths.
        size = [max(2, round(n * scale / 2) * 2) for n in (frame.width, frame.height)]
        small = frame.reformat(width=size[0], height=size[1], format="gray")
        return small.to_ndarray()

    def codes(self) -> UInt[np.ndarray, "h w 3"]:
        """Return display values in sRGB, upright: of more than 8 bits, and of light, 16."""
        signal = _signal(self._decoded)
        primaries = icc.PRIMARIES.get(int(self._decoded.color_primaries), icc.BT709)
        if self.transfer is not None:
            light = icc.to_light(signal, self.transfer) @ icc.to_srgb_matrix(primaries).T
            codes = icc.encode_16(light)
        elif primaries is not icc.BT709:
            codes = icc.encode_16(
                srgb_decode(np.clip(signal, 0, 1)) @ icc.to_srgb_matrix(primaries).T
            )
        elif max(c.bits for c in self._decoded.format.components) > 8:
            codes = np.rint(np.clip(signal, 0, 1) * 65535).astype(np.uint16)
        else:
            codes = np.rint(np.clip(signal, 0, 1) * 255).astype(np.uint8)
        if self.square != 1:
            width = round(codes.shape[1] * self.square)
            how = cv2.INTER_AREA if self.square < 1 else cv2.INTER_LINEAR
            codes = cv2.resize(codes, (width, codes.shape[0]), interpolation=how)
        return np.ascontiguousarray(np.rot90(codes, self.turn))


def frames_of(path: Path) -> Iterator[Frame]:
    """Yield all frames of a video.

    Raises UserError: it is not one, holds none, changes its size, or breaks off before two frames.
    """
    with _opened(path) as (container, stream):
        stream.thread_type = "AUTO"
        rate = float(stream.average_rate or 30)
        ratio = stream.sample_aspect_ratio
        square = float(ratio) if ratio else 1.0
        first: tuple[int, int] | None = None
        begin: float | None = None
        number = 0
        try:
            for decoded in container.decode(stream):
                size = decoded.width, decoded.height
                if size != (first or size):
                    assert first is not None
                    why = f"changes its size: frame {number} is {size[0]}x{size[1]}, those "
                    why += f"before are {first[0]}x{first[1]}."
                    raise broken(path, why, "cut it into parts of one size and fit one of them")
                first = size
                time = float(decoded.time) if decoded.time is not None else number / rate
                begin = time if begin is None else begin
                turn = round(decoded.rotation / 90) % 4
                yield Frame(number, time - begin, turn, square, decoded)
                number += 1
        except av.FFmpegError as error:
            # The rest of a broken file is lost, what came before is fine: the caller says how many.
            if number < 2:
                why = f"cannot be decoded: {error.strerror or error}."
                raise broken(path, why, _AGAIN) from None


def expected_frames(path: Path) -> int | None:
    """Return how many frames the file claims to hold, or None."""
    with _opened(path) as (container, stream):
        if stream.frames:
            return int(stream.frames)
        if container.duration and stream.average_rate:
            return round(container.duration / av.time_base * float(stream.average_rate))
    return None


def video_size(path: Path) -> tuple[int, int]:
    """Return (width, height) of the first frame, upright; errors are those of `frames_of`."""
    for frame in frames_of(path):
        return frame.size
    raise no_frames(path, 0)


def no_frames(path: Path, count: int) -> UserError:
    """Return the error for a video that is too short."""
    held = "no frame" if count == 0 else "one frame" if count == 1 else f"{count} frames"
    why = f"holds {held}; a scene needs several, taken from different places."
    return broken(path, why, _SHORT)


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, Any]]:
    try:
        container = av.open(str(path))
    except (av.FFmpegError, OSError) as error:
        why = f"cannot be opened as a video: {error.strerror or error}."
        raise broken(path, why, f"{_AGAIN}, as .mp4 or .mov") from None
    with container:
        # Covers of music are video streams of one picture.
        cover = int(Disposition.attached_pic)
        streams = [s for s in container.streams.video if not int(s.disposition) & cover]
        if not streams:
            kinds = sorted({s.type for s in container.streams}) or ["nothing"]
            why = f"holds no video, but {', '.join(kinds)}."
            raise broken(path, why, "name the file that holds the pictures")
        yield container, streams[0]


def _signal(frame: av.VideoFrame) -> Float[np.ndarray, "h w 3"]:
    """Return red, green and blue as coded, 0 to 1 where they are in range.

    swscale only brings the chroma to full size: its RGB is off by up to 3 of 255 levels.
    """
    if frame.format.is_rgb:
        return frame.reformat(format="rgb48le").to_ndarray().astype(np.float32) / 65535
    full = int(frame.color_range) == _FULL_RANGE or frame.format.name.startswith("yuvj")
    span = 2 if full else 1
    planar = frame.reformat(format="yuv444p16le", src_color_range=span, dst_color_range=span)
    coded = planar.to_ndarray()
    if coded.shape[0] == 3 and coded.shape[2] != 3:
        coded = np.moveaxis(coded, 0, -1)
    y, u, v = np.moveaxis(coded.astype(np.float32) / 256, -1, 0)
    foot, luma, chroma = (0, 255, 255) if full else (16, 219, 224)
    y, u, v = (y - foot) / luma, (u - 128) / chroma, (v - 128) / chroma
    usual = 1 if min(frame.width, frame.height) >= _SMALLEST_HD else 5
    kr, kb = _LUMA.get(int(cast(int, frame.colorspace)), _LUMA[usual])
    red, blue = y + 2 * (1 - kr) * v, y + 2 * (1 - kb) * u
    return np.stack([red, (y - kr * red - kb * blue) / (1 - kr - kb), blue], axis=-1)


def read_video(path: Path, cfg: DataConfig, work_dir: Path | None, report: Report) -> Converted:
    """Return the chosen frames of a video as photographs, kept in `work_dir` or the user's cache.

    Raises UserError: it is not a video, holds none, changes its size, or shows too little.
    """
    key = {"version": _VERSION, "file": file_fingerprints([path])}
    key |= {"every": cfg.every, "max_frames": cfg.max_frames}

    def build(folder: Path) -> None:
        record = _keep(path, cfg, folder, report)
        write_text(folder / RECORD, json.dumps(record, indent=1))

    with cached_folder(cache_of(path, work_dir), "video", key, build) as folder:
        record = json.loads((folder / RECORD).read_text())
    paths = [folder / frame["file"] for frame in record["frames"]]
    originals = {file.name: file for file in paths}
    return Converted(folder, paths, originals, tuple(record["notes"]), record["known"])


def _keep(path: Path, cfg: DataConfig, folder: Path, report: Report) -> dict[str, Any]:
    """Choose frames and write them; return a record of it."""
    expected, seen = expected_frames(path), 0

    def watched() -> Iterator[tuple[int, np.ndarray]]:
        nonlocal seen
        for frame in frames_of(path):
            if seen % 100 == 0:
                total = "" if expected is None else f" of {expected}"
                report(f"looking through the video: frame {frame.number}{total}")
            seen += 1
            yield frame.number, frame.grey(WIDTH)

    if cfg.every is None:
        found = {one.number: one for one in choose_frames(watched())}
        how = "sharp ones, each from a new place"
    else:
        found = {n: Chosen(n, 0.0, None) for n, _ in watched() if n % cfg.every == 0}
        how = "all of them" if cfg.every == 1 else f"every {cfg.every}th"
    if seen < 2:
        raise no_frames(path, seen)
    kept = {n: found[n] for n in thinned(list(found), cfg.max_frames)}
    thin = f", thinned from {len(found)} (--max-frames)" if len(kept) < len(found) else ""
    notes = [f"Of {seen} frames of the video {len(kept)} are used: {how}{thin}."]
    if expected is not None and seen < expected - 2:
        notes.append(f"The video breaks off: {seen} of {expected} frames could be decoded.")
    if len(kept) < 2:
        why = f"{len(kept)} of {seen} frames would be used; a scene needs several, taken from "
        fix = f"{_SHORT}, or take frames by number with --every"
        raise broken(f"{path}:", why + "different places.", fix)
    records, transfers = _write(path, kept, folder, report)
    if len(transfers) > 1 and None in transfers:
        notes.append("The transfer function changes within the video: its curve is not known.")
    known = None if None in transfers else ", ".join(_TRANSFER_NAMES[t] for t in sorted(transfers))  # type: ignore[index, type-var]
    return {"known": known, "notes": notes, "frames": records}


def _write(
    path: Path, kept: dict[int, Chosen], folder: Path, report: Report
) -> tuple[list[dict[str, Any]], set[str | None]]:
    """Write frames as PNG; return a record of each, and their transfer functions."""
    records: list[dict[str, Any]] = []
    transfers: set[str | None] = set()
    for frame in frames_of(path):
        if (one := kept.get(frame.number)) is None:
            continue
        if len(records) % 10 == 0:
            report(f"keeping frames: {len(records)} of {len(kept)}")
        record = {"file": f"{frame.number:06d}.png", "frame": frame.number}
        write_png(folder / record["file"], frame.codes())
        transfers.add(frame.transfer)
        record |= {"time": round(frame.time, 6), "turn": 90 * frame.turn}
        way = None if one.way is None else vars(one.way)
        records.append(record | {"sharpness": one.sharpness, "way": way})
        if len(records) == len(kept):
            break
    return records, transfers
