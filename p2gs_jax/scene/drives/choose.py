"""Which drive, and which of its cameras and frames are used."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from p2gs_jax.errors import UserError

# Words that data sets put around the names of their cameras.
_AROUND = re.compile(r"(?:^|_)(?:camera|cam|ring)(?=_|$)")


# As many drives are listed in a complaint.
LISTED = 5


def chosen_drive(asked: str | None, there: Sequence[str], root: Path) -> str:
    """Return the drive that was asked for; nothing asked: the only one.

    Args:
        asked: its name, or how that begins.
        there: names of all drives.
        root: folder that holds them, for complaints.

    Raises:
        UserError: none is so named, or several could be meant.
    """
    fits = [name for name in there if name == asked] or [
        name for name in there if asked is None or name.startswith(asked)
    ]
    if len(fits) == 1:
        return fits[0]
    listed = sorted(fits or there)
    names = ", ".join(listed[:LISTED]) + (", ..." if len(listed) > LISTED else "")
    if asked is None:
        message = f"{root} holds {len(there)} drives: {names}"
    elif fits:
        message = f"{len(fits)} drives of {root} begin with {asked!r}: {names}"
    else:
        message = f"{root} holds no drive {asked!r}; there are {names or 'none'}"
    raise UserError(message, fix="name one of them: --drive NAME")


def short_name(camera: str) -> str:
    """Return a camera's name as people say it: `front_left` for `CAM_FRONT_LEFT`."""
    return _AROUND.sub("", camera.lower()).strip("_") or camera.lower()


def chosen_cameras(asked: Sequence[str], there: Sequence[str]) -> list[str]:
    """Return the cameras that were asked for, as the data set names them; nothing asked: all.

    Args:
        asked: names, or short names.
        there: all cameras.

    Raises:
        UserError: one is unknown.
    """
    if not asked:
        return list(there)
    found = []
    for name in asked:
        fits = [c for c in there if c == name] or [
            c for c in there if short_name(c) == short_name(name)
        ]
        if not fits:
            listed = ", ".join(map(short_name, there))
            raise UserError(f"there is no camera {name!r}", fix=f"choose of {listed}")
        found += [c for c in fits if c not in found]
    return found


def chosen_frames(asked: str | None, there: Sequence[int]) -> list[int]:
    """Return the frames of a slice FIRST:END[:STEP] among all of a drive; nothing asked: all.

    Args:
        asked: as Python slices: a part may be empty, negative numbers count from the end.
        there: numbers of the frames, rising.

    Raises:
        UserError: that is no slice, or holds no frame.
    """
    if asked is None:
        return list(there)
    parts = asked.split(":")
    try:
        numbers = [int(part) if part.strip() else None for part in parts]
        if len(numbers) not in (2, 3):
            raise ValueError(asked)
        found = list(there)[slice(*numbers)]
    except ValueError:
        raise UserError(
            f"--frames {asked!r} is no slice", fix="write FIRST:END or FIRST:END:STEP, as 0:30:2"
        ) from None
    if not found:
        raise UserError(
            f"--frames {asked} holds no frame of this drive", fix=f"it has {len(there)}, from 0 on"
        )
    return found
