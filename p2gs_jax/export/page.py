"""One HTML file with the scene: linear light, developed in the browser (docs/rendering.md).

The browser renders with `web/*.js`, by the formulas of our renderer. Nothing is loaded from
elsewhere. The page's security policy states the hash of its script, so that no other script runs,
whatever the names of views.
"""

from __future__ import annotations

import base64
import functools
import hashlib
import html
import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Any

from p2gs_jax.core.atomic import plain, write_text
from p2gs_jax.core.numerics import evenly_spaced
from p2gs_jax.core.text import printable
from p2gs_jax.errors import UserError
from p2gs_jax.export.page_scene import embedded_photographs, page_scene, rounded
from p2gs_jax.export.page_splats import PageSplats, RunPicture, fit_into, page_error, radiance_of
from p2gs_jax.photometry.display import DisplayTransform, develop
from p2gs_jax.render.capacity import make_renderer
from p2gs_jax.run.read import Run

SCRIPTS = ("decode", "shaders", "renderer", "camera", "link", "marks", "hands", "main")
# Views for measuring the error, and views for weighing the Gaussians.
JUDGED, WEIGHED = 12, 60
MEGABYTE = 1_000_000
# Bytes reserved for sentences and for the header of the Gaussians.
RESERVE = 4000


@dataclass(frozen=True)
class Page:
    """A written page: its bytes, Gaussians, and sentences on its error."""

    size: int
    splats: PageSplats
    sentences: tuple[str, ...]


def write_page(
    path: Path,
    fitted: Run,
    look: DisplayTransform,
    *,
    size_mb: float,
    photographs: int = 0,
    say: Callable[[str], None] = lambda text: None,
) -> Page:
    """Write the page of at most `size_mb` million bytes.

    It opens with `look`, and has at most `photographs` photographs for the split view. `say`
    receives progress. Raises UserError: too few Gaussians fit, or a photograph is missing.
    """
    gaussians, scene = fitted.as_of(), fitted.scene
    render = make_renderer(fitted.cfg.render)
    say("Rendering true pictures")
    pictures = []
    for i in map(int, evenly_spaced(len(scene.views), JUDGED)):
        # The page cannot apply a learned correction.
        camera, display = fitted.camera(i), replace(fitted.own_display(i), correction=None)
        linear, name = radiance_of(gaussians, camera, render), scene.views[i].name
        pictures.append(RunPicture(name, camera, display, linear, develop(linear, display)))
    train = scene.train_indices
    weighed = [fitted.camera(train[k]) for k in evenly_spaced(len(train), WEIGHED)]
    embedded = embedded_photographs(fitted, photographs)
    data = page_scene(fitted, look, embedded)
    title = f"{fitted.folder.resolve().name}: linear light"
    most_bytes = _bytes_for_splats(int(size_mb * MEGABYTE), page_text(title, data, b""), size_mb)
    judge = functools.partial(page_error, pictures=pictures, render=render)
    splats = fit_into(most_bytes, gaussians, fitted.cfg.render, weighed, judge, say)
    sentences = _sentences(splats, fitted, size_mb)
    data |= {"splats": splats.packed.header, "about": [*sentences, *_fine_print(fitted)]}
    content = page_text(title, data, splats.packed.data)
    write_text(path, content)
    return Page(len(content.encode()), splats, tuple(sentences))


def page_text(title: str, scene: Mapping[str, Any], splats: bytes) -> str:
    """Return the page from its `page_scene` and its packed Gaussians (formats/packed.py)."""
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
        "scene": _json(scene),
        "splats": base64.b64encode(splats).decode(),
        "sorter": _source("sorter"),
        "script": script,
    }
    # One pass replaces all placeholders, so that inserted text is never searched for them.
    return re.sub(r"\{\{(\w+)\}\}", lambda found: parts[found[1]], _read("page.html"))


def _read(name: str) -> str:
    return resources.files("p2gs_jax.export").joinpath("web", name).read_text(encoding="utf-8")


def _source(name: str) -> str:
    """Return a script after a comment with its file name, for readers of the page's source."""
    return f"// {name}.js\n{_read(f'{name}.js')}"


def _json(value: Any) -> str:
    """Return JSON that cannot end its HTML element or begin a comment or a script."""
    text = json.dumps(rounded(plain(value)), allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c")


def _bytes_for_splats(budget: int, empty: str, size_mb: float) -> int:
    """Return the bytes for Gaussians besides the `empty` page; UserError: none remain."""
    rest = len(empty.encode()) + RESERVE
    if rest >= budget:
        raise UserError(
            f"--size-mb {size_mb:g} is too small: the page needs {rest / MEGABYTE:.2f} MB without "
            "any Gaussian.",
            fix="allow a larger page, or embed fewer --photographs",
        )
    # Base64 encodes 3 bytes in 4 characters.
    return (budget - rest) // 4 * 3


def _sentences(splats: PageSplats, fitted: Run, size_mb: float) -> list[str]:
    error, out = splats.error, []
    kept, drawn = splats.packed.count, splats.total - splats.unseen
    if splats.whole:
        out.append(f"The page has all {drawn} visible Gaussians, packed in few bits.")
    else:
        parts = [f"the {splats.dropped} least visible of {drawn} Gaussians"] * bool(splats.dropped)
        if splats.kept_degree < splats.degree:
            parts.append(f"harmonics above degree {splats.kept_degree} (of {splats.degree})")
        left_out = " and ".join(parts)
        out.append(f"Left out to stay within {size_mb:g} MB: {left_out}; {kept} Gaussians remain.")
    out.append(
        f"{error.views} views at their exposures, compared with the run's renderer: "
        f"median {error.psnr_median:.1f} dB, worst {error.psnr_worst:.1f} dB "
        f"({error.worst_view})."
    )
    out.append(
        f"The luminance of pixels that are not black differs by {error.stops_median:.4f} stops "
        f"(median), {error.stops_p99:.3f} (99 %), at most {error.stops_max:.2f}."
    )
    kind = fitted.cfg.photometry.appearance
    if kind is not None:
        out.append(
            f"The learned correction of display values ({kind}) is left out: the page has "
            "exposure, white balance, gamma, tone curve and vignetting."
        )
    return out


def _fine_print(fitted: Run) -> list[str]:
    out = [
        "Light is linear until the last step: exposure is a factor on it, and +1 EV doubles it. "
        "Exposures are relative to the geometric mean of the training photographs.",
        "The white point is the light that becomes display white, in stops from the white of the "
        "tone curve alone. Mid-grey and darker tones stay; highlights are compressed or stretched.",
        "This file loads nothing from elsewhere and sends nothing.",
    ]
    if fitted.owner is not None:
        out.insert(0, "Moving objects are at their places in the middle of the drive.")
    return out
