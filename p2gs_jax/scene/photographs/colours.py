"""What photographs say of their colours, told to the user: profiles and gain maps."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from pathlib import Path

from PIL import Image

from p2gs_jax.scene.photographs.gain_maps import has_gain_map
from p2gs_jax.scene.photographs.profiles import profile_of


def colour_notes(paths: Iterable[Path]) -> tuple[str, ...]:
    """Return what there is to say; headers are read, no pixels.

    Args:
        paths: of photographs, as the user has them or developed.
    """
    applied: Counter[str] = Counter()
    kept: Counter[str] = Counter()
    maps = 0
    for path in paths:
        maps += has_gain_map(path)
        try:
            with Image.open(path) as image:
                profile = profile_of(image)
        except Exception:  # whoever decodes it complains
            continue
        if profile is not None:
            (kept if profile.decode is None else applied)[profile.name] += 1
    out = [
        f"{n} photographs are in {name}; they are converted to sRGB." for name, n in applied.items()
    ]
    out += [
        f"{n} photographs have the colour profile {name}, made of tables, which is not applied: "
        "their colours count as sRGB."
        for name, n in kept.items()
    ]
    if maps:
        out.append(
            f"{maps} photographs carry a gain map for bright displays; the photograph itself is "
            "used, the map is not."
        )
    return tuple(out)
