"""Exposures of a drone's video: the camera settings in the .SRT that DJI writes beside it.

A subtitle holds the settings of one frame, or of one second in older models:

    [iso : 100] [shutter : 1/500.0] [fnum : 280]    also [fnum: 2.8]
    ISO:100 Shutter:60 EV:0 Fnum:2.2                also Fnum:F2.2
    F/2.8, SS 206.14, ISO 150, EV 0

The f-number may be multiplied by 100, and the shutter may lack its `1/`. A frame's settings
are found by time, because not every model writes a subtitle for each frame.
"""

from __future__ import annotations

import re
from bisect import bisect_right
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from p2gs_jax.scene.convert.readers import ExifSettings

_SUBTITLE = re.compile(r"(?=^.*-->)", re.MULTILINE)
_START = re.compile(r"(\d+):(\d\d):(\d\d)[,.](\d{3})\s*-->")
_ISO = re.compile(r"\bISO\s*:?\s*(\d+)", re.IGNORECASE)
_SHUTTER = re.compile(r"\b(?:Shutter\s*:|SS)\s*(?:1/)?(\d+(?:\.\d+)?)", re.IGNORECASE)
_F_NUMBER = re.compile(r"\b(?:Fnum\s*:\s*F?|F/)(\d+(?:\.\d+)?)", re.IGNORECASE)
# A larger f-number was multiplied by 100.
_LARGEST_F_NUMBER = 64
# Times are rounded: a subtitle that starts up to this many seconds after a frame belongs to it.
_ROUNDED = 0.004


class Shot(NamedTuple):
    """Settings that hold from `time` on, seconds after the start of the video."""

    time: float
    settings: ExifSettings


def srt_beside(video: Path) -> Path | None:
    """Return the path of a video's subtitles, or None."""
    names = (video.with_suffix(suffix) for suffix in (".SRT", ".srt"))
    return next((path for path in names if path.is_file()), None)


def read_shots(path: Path) -> list[Shot]:
    """Return the settings in subtitles by time; subtitles without shutter or ISO are skipped."""
    shots = []
    for part in _SUBTITLE.split(path.read_text("utf-8-sig", "replace"))[1:]:
        start, settings = _START.search(part), _settings(part)
        if start and settings.time and settings.iso:
            hours, minutes, seconds, ms = map(int, start.groups())
            shots.append(Shot(3600 * hours + 60 * minutes + seconds + ms / 1000, settings))
    return sorted(shots, key=lambda shot: shot.time)


def settings_at(shots: Sequence[Shot], time: float) -> ExifSettings:
    """Return the settings of the frame at a time, seconds; `shots` must not be empty."""
    after = bisect_right(shots, time + _ROUNDED, key=lambda shot: shot.time)
    return shots[max(after - 1, 0)].settings


def _settings(text: str) -> ExifSettings:
    iso, shutter, f_number = (_number(p, text) for p in (_ISO, _SHUTTER, _F_NUMBER))
    if f_number is not None and f_number > _LARGEST_F_NUMBER:
        f_number /= 100
    return ExifSettings(1 / shutter if shutter else None, f_number or None, iso or None)


def _number(pattern: re.Pattern[str], text: str) -> float | None:
    found = pattern.search(text)
    return None if found is None else float(found[1])
