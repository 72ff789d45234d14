"""One HTML file that is the scene: linear light, developed in the browser (docs/rendering.md).

The browser draws with `web/*.js`, by the formulas of our renderer. Nothing is loaded from
elsewhere, and no other script than this one runs, whatever names the views have: the policy in the
page names its hash.
"""

from __future__ import annotations

import base64
import functools
import hashlib
import html
import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

from p2gs_jax.core.atomic import plain, write_text
from p2gs_jax.core.numerics import evenly_spaced
from p2gs_jax.core.text import printable
from p2gs_jax.errors import UserError
from p2gs_jax.export.page_scene import embedded_photographs, page_scene, rounded, uncorrected
from p2gs_jax.export.page_splats import PageSplats, TruePicture, fit_into, linear_light, page_error
from p2gs_jax.photometry.display import DisplayTransform, develop
from p2gs_jax.render.capacity import make_renderer
from p2gs_jax.run.read import Run

SCRIPTS = ("decode", "shaders", "renderer", "camera", "link", "marks", "hands", "main")
# Views on which the error is measured, and views whose pictures say which Gaussians weigh most.
JUDGED, WEIGHED = 12, 60
MEGABYTE = 1_000_000
# Bytes kept for sentences and for what says how to read the Gaussians.
RESERVE = 4000
Say = Callable[[str], None]


@dataclass(frozen=True)
class Page:
    """What was written: bytes, Gaussians, photographs, and sentences for page and terminal."""

    size: int
    splats: PageSplats
    photographs: int
    sentences: tuple[str, ...]


def write_page(
    path: Path,
    fitted: Run,
    look: DisplayTransform,
    *,
    size_mb: float,
    photographs: int = 0,
    say: Say = lambda text: None,
) -> Page:
    """Write the page of at most `size_mb` million bytes, with photographs for the split view.

    The page opens with `look`; `say` receives what is going on. A UserError says that too little of
    the scene fits, or that photographs are asked for and gone.
    """
    gaussians, scene = fitted.as_of(), fitted.scene
    render = make_renderer(fitted.cfg.render)
    say("Rendering true pictures")
    pictures = []
    for i in map(int, evenly_spaced(len(scene.views), JUDGED)):
        camera, taken = fitted.camera(i), uncorrected(fitted.own_display(i))
        linear, name = linear_light(gaussians, camera, render), scene.views[i].name
        pictures.append(TruePicture(name, camera, taken, linear, develop(linear, taken)))
    train = scene.train_indices
    weighed = [fitted.camera(train[k]) for k in evenly_spaced(len(train), WEIGHED)]
    embedded = embedded_photographs(fitted, photographs)
    known = page_scene(fitted, uncorrected(look), embedded)
    title = f"{fitted.folder.resolve().name}: linear light"
    room = _room(int(size_mb * MEGABYTE), page_text(title, known, b""), size_mb)
    judge = functools.partial(page_error, pictures=pictures, render=render)
    splats = fit_into(room, gaussians, fitted.cfg.render, weighed, judge, say)
    sentences = _sentences(splats, fitted, size_mb)
    known |= {"splats": splats.packed.header, "about": [*sentences, *_fine_print(fitted)]}
    content = page_text(title, known, splats.packed.data)
    write_text(path, content)
    return Page(len(content.encode()), splats, len(embedded), tuple(sentences))


def page_text(title: str, known: Mapping[str, Any], data: bytes) -> str:
    """Return the page.

    `known` is what it reads besides the packed Gaussians (formats/packed.py).
    """
    script = '(() => {\n"use strict";\n' + "\n".join(map(_source, SCRIPTS)) + "})();\n"
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    policy = (
        f"default-src 'none'; script-src 'sha256-{digest}'; worker-src blob:; "
        "style-src 'unsafe-inline'; img-src data:"
    )
    parts = {
        "policy": policy,
        "title": html.escape(printable(title)),
        "css": _read("page.css"),
        "scene": _json(known),
        "splats": base64.b64encode(data).decode(),
        "sorter": _source("sorter"),
        "script": script,
    }
    # All at once: what is put in is never searched for places to put something.
    return re.sub(r"\{\{(\w+)\}\}", lambda found: parts[found[1]], _read("page.html"))


def _read(name: str) -> str:
    return resources.files("p2gs_jax.export").joinpath("web", name).read_text(encoding="utf-8")


def _source(name: str) -> str:
    """Return a script; the name of a file of its own helps whoever reads the page's source."""
    return f"// {name}.js\n{_read(f'{name}.js')}"


def _json(value: Any) -> str:
    """Return JSON that cannot end the element it stands in, nor open a comment or a script."""
    said = json.dumps(rounded(plain(value)), allow_nan=False, separators=(",", ":"))
    return said.replace("<", "\\u003c")


def _room(budget: int, empty: str, size_mb: float) -> int:
    """Return how many bytes of Gaussians fit; a UserError says that none do."""
    rest = len(empty.encode()) + RESERVE
    if rest >= budget:
        raise UserError(
            f"--size-mb {size_mb:g} is too small: the page takes {rest / MEGABYTE:.2f} MB without "
            "any Gaussian.",
            fix="allow a larger page, or embed fewer --photographs",
        )
    # Base64 makes 4 characters of 3 bytes.
    return (budget - rest) // 4 * 3


def _sentences(splats: PageSplats, fitted: Run, size_mb: float) -> list[str]:
    error, said = splats.error, []
    kept, seen = splats.packed.count, splats.of - splats.unseen
    if splats.whole:
        said.append(f"All {seen} Gaussians that can be seen, packed in few bits.")
    else:
        what = [f"{splats.dropped} of {seen} Gaussians that weigh least"] * bool(splats.dropped)
        if splats.kept_degree < splats.degree:
            what.append(f"harmonics above degree {splats.kept_degree} (of {splats.degree})")
        left_out = " and ".join(what)
        said.append(f"Left out to stay within {size_mb:g} MB: {left_out}; {kept} Gaussians remain.")
    said.append(
        f"Against our renderer with nothing left out or rounded, {error.views} views at their own "
        f"exposures: median {error.psnr_median:.1f} dB, worst {error.psnr_worst:.1f} dB "
        f"({error.worst_view})."
    )
    said.append(
        f"Luminance of pixels that are not black is off by {error.stops_median:.4f} stops "
        f"(median), {error.stops_p99:.3f} (99 %), at most {error.stops_max:.2f}."
    )
    kind = fitted.cfg.photometry.appearance
    if kind is not None:
        said.append(
            f"The learned correction of display values ({kind}) is left out: the page has "
            "exposure, white balance, gamma, curve and vignetting."
        )
    return said


def _fine_print(fitted: Run) -> list[str]:
    out = [
        "Light is linear until the last step: exposure is a factor on it, +1 EV doubles it. "
        "Exposures count from the mean (geometric) of the training photographs.",
        "White point: how much light becomes display white, in stops from what the curve alone "
        "makes white. Mid-grey and what is darker stay; highlights are compressed or stretched.",
        "This file loads nothing from elsewhere and sends nothing.",
    ]
    if fitted.owner is not None:
        out.insert(0, "Things that move stand where they were in the middle of the drive.")
    return out
