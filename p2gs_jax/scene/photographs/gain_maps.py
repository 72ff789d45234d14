"""Gain maps beside photographs: what a phone adds for bright displays.

The photograph itself, the base image, is what is used. The map says how a display may brighten it,
place by place; it undoes the phone's tone mapping only as far as the phone chose to.
"""

from __future__ import annotations

import re
from pathlib import Path

# Ultra HDR (Android) in XMP, ISO 21496-1 in a segment of its own, and Apple's.
_MARKS = re.compile(
    rb"http://ns\.adobe\.com/hdr-gain-map/1\.0/|urn:iso:std:iso:ts:21496:-1|"
    rb"http://ns\.apple\.com/HDRGainMap/1\.0/|urn:com:apple:photo:2020:aux:hdrgainmap"
)
_HEAD = 512 * 1024
_START_OF_SCAN = 0xDA


def has_gain_map(path: Path) -> bool:
    """Return whether a JPEG or HEIC carries a gain map."""
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD)
    except OSError:
        return False
    if head[:2] == b"\xff\xd8":
        return _MARKS.search(_segments(head)) is not None
    return head[4:8] == b"ftyp" and _MARKS.search(head) is not None


def _segments(head: bytes) -> bytes:
    """Return a JPEG's header: what precedes its coded pixels."""
    at = 2
    while at + 4 <= len(head) and head[at] == 0xFF and head[at + 1] != _START_OF_SCAN:
        at += 2 + int.from_bytes(head[at + 2 : at + 4], "big")
    return head[:at]
