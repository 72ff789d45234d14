"""Exposure brackets: several photographs of one camera at one pose, with different exposures."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from pathlib import PurePosixPath

import numpy as np

from p2gs_jax.core.text import count_of, natural
from p2gs_jax.scene.rigid import camera_centers
from p2gs_jax.types import View

# Ends of names that state an exposure: `_-2EV`, `_ev+1.3`, `_exp2`.
_NUMBER = r"[+-]?\d+(?:\.\d+)?"
_EXPOSURE = re.compile(rf"[_-](?:ev_?{_NUMBER}|{_NUMBER}_?ev|exp(?:osure)?_?\d+)$", re.IGNORECASE)
# Poses are nearly the same within these limits: a distance, divided by the median distance of the
# camera's centres from their middle, and the cosine of a rotation by 0.5 degrees.
_NEAR, _TURNED = 0.01, float(np.cos(np.radians(0.5)))
# The smallest difference of two exposures of a bracket, stops.
_STEP = 0.2


def names_of_brackets(names: Sequence[str]) -> list[str]:
    """Return for each photograph its name without suffix and stated exposure."""
    paths = [PurePosixPath(name) for name in names]
    return [path.with_name(_EXPOSURE.sub("", path.stem)).as_posix() for path in paths]


def brackets(views: Sequence[View]) -> list[int]:
    """Return for each view a number that all views of its bracket share.

    Views of one camera form a bracket if their names differ only by a stated exposure, or if they
    follow each other by name and have the same pose. If poses are only nearly the same, or if the
    camera never moves, all exposures must be known and differ.
    """
    names = names_of_brackets([view.name for view in views])
    centers = camera_centers(np.stack([view.viewmat for view in views]))
    cameras = np.array([view.camera for view in views])
    radius = {
        camera: float(np.median(np.linalg.norm(group - np.median(group, 0), axis=1)))
        for camera in np.unique(cameras)
        for group in [centers[cameras == camera]]
    }
    named, last = dict[tuple[str, str], int](), dict[str, list[int]]()
    out = [0] * len(views)
    for row in sorted(range(len(views)), key=lambda row: natural(views[row].name)):
        camera, before = views[row].camera, last.get(views[row].camera, [])
        if names[row] != PurePosixPath(views[row].name).with_suffix("").as_posix():
            out[row] = named.setdefault((camera, names[row]), row)
        elif before and _continues([views[r] for r in [*before, row]], radius[camera]):
            out[row] = out[before[0]]
            before.append(row)
        else:
            out[row], last[camera] = row, [row]
    return out


def _continues(views: Sequence[View], radius: float) -> bool:
    """Return whether the last of some views belongs to the bracket of the others."""
    first, last = (view.viewmat.astype(np.float64) for view in (views[0], views[-1]))
    if radius > 0 and np.array_equal(first, last):
        return True
    between = camera_centers(np.stack([first, last]))
    distance = float(np.linalg.norm(between[1] - between[0]))
    cosine = float(np.trace(first[:3, :3] @ last[:3, :3].T) - 1) / 2
    *others, ev = (view.exif_ev for view in views)
    differ = ev is not None and all(o is not None and abs(o - ev) >= _STEP for o in others)
    return differ and distance <= _NEAR * radius and cosine >= _TURNED


def bracket_notes(keys: Sequence[object]) -> list[str]:
    """Return a note on brackets, or no note; `keys` name the bracket of each photograph."""
    sizes = [size for size in Counter(keys).values() if size > 1]
    if not sizes:
        return []
    low, high = min(sizes), max(sizes)
    exposures = f"{low} exposures" if low == high else f"{low} to {high} exposures"
    return [f"{count_of(len(sizes), 'bracket')} of {exposures}."]
