"""Draws this folder's SVG files: `python docs/images/draw.py` writes them beside it.

What can be computed is computed: the tiles that the ellipses reach, the order of the lanes, and
who may import whom (from the contracts in pyproject.toml).
"""

from __future__ import annotations

import ast
import tomllib
from html import escape
from pathlib import Path

import numpy as np

INK, FAINT, PAPER = "#1f2933", "#9aa5b1", "#ffffff"
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
FONT = "Helvetica, Arial, 'DejaVu Sans', sans-serif"


class Drawing:
    """SVG elements, one after the other."""

    def __init__(self, width: int, height: int, title: str):
        self.size = width, height
        self.parts = [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" '
            f'width="{width}" height="{height}" font-family="{FONT}" role="img">',
            f"<title>{escape(title)}</title>",
            '<defs><marker id="head" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" '
            f'markerHeight="7" orient="auto"><path d="M0 0L8 4L0 8z" fill="{INK}"/></marker>'
            "</defs>",
            f'<rect width="{width}" height="{height}" rx="8" fill="{PAPER}" stroke="{FAINT}"/>',
        ]

    def add(self, element: str) -> None:
        self.parts.append(element)

    def rect(self, x, y, w, h, fill="none", stroke=INK, opacity=1.0, width=1.0) -> None:
        self.add(
            f'<rect x="{x:g}" y="{y:g}" width="{w:g}" height="{h:g}" fill="{fill}" '
            f'fill-opacity="{opacity:g}" stroke="{stroke}" stroke-width="{width:g}"/>'
        )

    def line(self, x0, y0, x1, y1, color=INK, width=1.2, arrow=False, dash="") -> None:
        head = ' marker-end="url(#head)"' if arrow else ""
        dashes = f' stroke-dasharray="{dash}"' if dash else ""
        self.add(
            f'<line x1="{x0:g}" y1="{y0:g}" x2="{x1:g}" y2="{y1:g}" stroke="{color}" '
            f'stroke-width="{width:g}"{dashes}{head}/>'
        )

    def text(self, x, y, words, size=12.5, anchor="start", color=INK, bold=False) -> None:
        weight = ' font-weight="bold"' if bold else ""
        self.add(
            f'<text x="{x:g}" y="{y:g}" font-size="{size:g}" text-anchor="{anchor}" '
            f'fill="{color}"{weight}>{escape(words)}</text>'
        )

    def lines(self, x, y, rows, size=12.5, step=17.0) -> None:
        for i, row in enumerate(rows):
            self.text(x, y + i * step, row, size)

    def dot(self, x, y, radius=2.5, fill=INK) -> None:
        self.add(f'<circle cx="{x:g}" cy="{y:g}" r="{radius:g}" fill="{fill}"/>')

    def save(self, path: Path) -> None:
        path.write_text("\n".join([*self.parts, "</svg>"]) + "\n", encoding="utf-8")


# ------------------------------------------------------------------ the kernel

TILE, ACROSS, DOWN = (44, 22), 7, 5
# Name, centre in tiles, half axes in tiles, angle; front to back.
SPLATS = (
    ("a", (1.9, 1.5), (1.45, 0.5), 24.0),
    ("b", (4.3, 2.5), (1.7, 0.85), -28.0),
    ("c", (2.6, 3.6), (1.5, 0.42), -4.0),
)


def outline(splat) -> np.ndarray:
    """Return points of a splat's cutoff ellipse, in pixels of the drawing."""
    _, center, axes, degrees = splat
    t, angle = np.linspace(0, 2 * np.pi, 721), np.radians(degrees)
    x, y = axes[0] * TILE[0] * np.cos(t), axes[1] * 2 * TILE[1] * np.sin(t)
    return np.stack(
        [
            center[0] * TILE[0] + np.cos(angle) * x - np.sin(angle) * y,
            center[1] * TILE[1] + np.sin(angle) * x + np.cos(angle) * y,
        ],
        1,
    )


def spans(splat) -> dict[int, tuple[int, int]]:
    """Return the first and last tile column that a splat reaches in every row of tiles."""
    points, found = outline(splat), {}
    for row in range(DOWN):
        top, bottom = row * TILE[1], (row + 1) * TILE[1]
        inside = points[(points[:, 1] >= top) & (points[:, 1] <= bottom), 0]
        if len(inside):
            first, last = (int(v // TILE[0]) for v in (inside.min(), inside.max()))
            found[row] = max(first, 0), min(last, ACROSS - 1)
    return found


def draw_tiles(d: Drawing, x: float, y: float) -> None:
    for row in range(DOWN):
        for column in range(ACROSS):
            d.rect(x + column * TILE[0], y + row * TILE[1], *TILE, stroke="#d5dbe1")
    for splat, color in reversed(list(zip(SPLATS, COLORS, strict=False))):
        for row, (first, last) in spans(splat).items():
            width = (last - first + 1) * TILE[0]
            d.rect(x + first * TILE[0], y + row * TILE[1], width, TILE[1], color, "none", 0.13)
        path = " ".join(f"{x + px:.1f},{y + py:.1f}" for px, py in outline(splat)[::12])
        d.add(
            f'<polygon points="{path}" fill="{color}" fill-opacity="0.3" stroke="{color}" '
            'stroke-width="1.6"/>'
        )
        d.text(x + splat[1][0] * TILE[0], y + splat[1][1] * TILE[1] + 5, splat[0], 15, "middle")


def draw_list(d: Drawing, x: float, y: float) -> None:
    """The flat list: ids by tile, and by depth within; offsets say where tiles begin."""
    by_tile: dict[int, list[int]] = {}
    for i, splat in enumerate(SPLATS):
        for row, (first, last) in spans(splat).items():
            for column in range(first, last + 1):
                by_tile.setdefault(row * ACROSS + column, []).append(i)
    cell, at = 15.0, x
    for tile in sorted(by_tile):
        d.line(at, y - 4, at, y + 22, INK, 1.6)
        if at == x or len(by_tile[tile]) > 1:
            d.text(at + 2, y + 35, str(tile), 10, color="#52606d")
        for i in by_tile[tile]:
            d.rect(at, y, cell, 18, COLORS[i], PAPER, 0.45)
            d.text(at + cell / 2, y + 13.5, SPLATS[i][0], 12, "middle")
            at += cell
    d.line(at, y - 4, at, y + 22, INK, 1.6)


# Chunks of 16 entries in the segments of each tile's list, and after how many of a segment's all
# pixels are opaque.
LISTS = {
    "t5": (4, 4, 1),
    "t2": (4, 4),
    "t7": (4, 2),
    "t1": (4, 1),
    "t9": (4,),
    "t3": (4,),
    "t8": (3,),
    "t4": (2,),
    "t6": (2,),
    "t0": (1,),
}
OPAQUE = {"t2": (1, 2), "t9": (0, 3)}
LANES = 3


def schedule() -> list[list[tuple[str, str, int, int]]]:
    """Return (tile, name, start, length) by lane: whoever is free takes the next longest."""
    lanes: list[list[tuple[str, str, int, int]]] = [[] for _ in range(LANES)]
    free = [0] * LANES
    parts = [(tile, k, n) for tile, chunks in LISTS.items() for k, n in enumerate(chunks)]
    for tile, k, chunks in sorted(parts, key=lambda part: -part[2]):
        lane = free.index(min(free))
        cut, end = OPAQUE.get(tile, (None, 0))
        length = end if cut == k else chunks
        name = tile + "abc"[k] if len(LISTS[tile]) > 1 else tile
        lanes[lane].append((tile, name, free[lane], length))
        free[lane] += length
    return lanes


def draw_lanes(d: Drawing, x: float, y: float) -> None:
    step, height = 25.0, 26.0
    for lane, tiles in enumerate(schedule()):
        top = y + lane * (height + 8)
        d.text(x - 10, top + 18, f"lane {lane}", anchor="end")
        for tile, name, start, length in tiles:
            color = COLORS[list(LISTS).index(tile) % len(COLORS)]
            for k in range(length):
                d.rect(x + (start + k) * step, top, step, height, color, PAPER, 0.35)
            d.rect(x + start * step, top, length * step, height)
            d.text(x + (start + length / 2) * step, top + 18, name, 12, "middle")
            if tile in OPAQUE and name == tile + "abc"[OPAQUE[tile][0]] * (len(LISTS[tile]) > 1):
                end = x + (start + length) * step
                d.line(end, top - 4, end, top + height + 4, COLORS[1], 3)
    end = y + LANES * (height + 8)
    d.line(x, end + 4, x + 430, end + 4, arrow=True)
    d.text(x + 434, end + 8, "iterations")


def kernel() -> Drawing:
    d = Drawing(980, 700, "How the renderer works")
    d.text(24, 34, "1  Project", 16, bold=True)
    d.lines(
        24,
        56,
        [
            "Every Gaussian becomes an ellipse at its alpha",
            "cutoff, and a row of floats: centre, factor of the",
            "inverse covariance, log opacity, radiance, depth.",
        ],
    )
    draw_tiles(d, 24, 108)
    d.text(24, 238, "Tiles of 16 x 8 pixels; shaded: those that an ellipse reaches.", 11.5)

    d.text(400, 34, "2  Bin, by counting", 16, bold=True)
    d.lines(
        400,
        56,
        [
            "Order by depth: at most three radix passes over the bits of the depths.",
            "Expand splats into rows of tiles; solve for the columns that the ellipse covers",
            "in each row (closed form, all rows at once); expand rows into tiles;",
            "place the entries by tile with one stable counting sort.",
        ],
    )
    draw_list(d, 400, 146)
    d.lines(
        400,
        206,
        [
            "One flat list, by tile and by depth within a tile. No cap per tile: the list has one",
            "capacity, counted exactly; if it overflows, the render is discarded and run again.",
        ],
    )
    d.line(24, 258, 956, 258, "#d5dbe1")

    d.text(24, 290, "3  Lanes", 16, bold=True)
    d.lines(
        24,
        312,
        [
            "256 lanes run side by side in one while_loop, each on a segment: a tile's list,",
            "or a part of a long one. An iteration composites the next 16 entries (one cell).",
            "A lane whose segment ends, or is opaque all over (orange bar), takes the longest.",
        ],
    )
    draw_lanes(d, 84, 372)
    d.lines(
        24,
        506,
        [
            "Parts of a list (t5a, t5b, t5c) are merged front to back afterwards:",
            "no lane waits for a long list, however uneven the lists are.",
        ],
    )

    d.text(600, 290, "4  One iteration of a lane", 16, bold=True)
    x, y = 600, 310
    d.rect(x, y, 58, 92, COLORS[0], INK, 0.18)
    d.text(x + 29, y + 50, "rows", anchor="middle")
    d.text(x + 29, y + 108, "16 x 9 or 10", 11, "middle")
    d.line(x + 62, y + 46, x + 84, y + 46, arrow=True)
    d.rect(x + 88, y, 128, 92, COLORS[4], INK, 0.25)
    d.text(x + 152, y + 44, "alpha", anchor="middle")
    d.text(x + 152, y + 61, "exp by polynomial", 11, "middle")
    d.text(x + 152, y + 108, "16 x 128 pixels", 11, "middle")
    d.line(x + 220, y + 46, x + 242, y + 46, arrow=True)
    d.rect(x + 246, y, 104, 92, COLORS[2], INK, 0.22)
    d.text(x + 298, y + 36, "w = alpha T", anchor="middle")
    d.text(x + 298, y + 56, "C += w c", anchor="middle")
    d.text(x + 298, y + 76, "T -= w", anchor="middle")
    d.text(x + 298, y + 108, "16 times", 11, "middle")
    d.lines(
        600,
        448,
        [
            "T: what is still transmitted. A tile stops once T times",
            "the brightest radiance can add at most 0.05 % of a",
            "pixel's brightest channel: bounded in HDR, where",
            "the usual T < 0.0001 is not.",
        ],
    )
    d.line(24, 540, 956, 540, "#d5dbe1")

    d.text(24, 572, "5  Backward", 16, bold=True)
    d.lines(
        24,
        594,
        [
            "The same queue again, front to back, with g the gradient of the image. R begins as",
            "the gradient-weighted radiance of the pixel and decreases with every entry:",
        ],
    )
    for k, formula in enumerate(
        ("q = w (c . g)", "R -= q", "d exponent = q - R alpha / (1 - alpha)")
    ):
        d.text(44 + (0, 140, 230)[k], 634, formula, 14)
    d.lines(
        24,
        660,
        [
            "No division by T. Six moments of it over the tile (1, x, y, xx, xy, yy), one matrix",
            "product, give the gradients of centre, covariance and opacity in closed form.",
        ],
    )
    draw_remaining(d, 650, 566)
    return d


def draw_remaining(d: Drawing, x: float, y: float) -> None:
    """R before every entry: what the entry takes, and what is left."""
    shares = (0.34, 0.22, 0.18, 0.1, 0.08, 0.05, 0.03)
    left, height, step = 1.0, 90.0, 36.0
    for k, share in enumerate(shares):
        top = y + (1 - left) * height
        d.rect(x + k * step, top, step - 6, left * height, "#e4e7eb", "none")
        d.rect(x + k * step, top, step - 6, share * height, COLORS[k % 6], "none", 0.7)
        left -= share
    d.text(x + 5, y + 18, "q")
    d.text(x + 5, y + 70, "R")
    d.line(x - 4, y + height, x + 280, y + height, arrow=True)
    d.text(x, y + height + 18, "entries, front to back: each takes its q from R", 11.5)


# ------------------------------------------------------------------ the conventions


def axes() -> Drawing:
    d = Drawing(980, 330, "Camera axes, pixel centres, and the names of images")
    d.text(24, 34, "Camera", 16, bold=True)
    x, y = 110, 160
    d.line(x, y, x + 120, y, COLORS[1], 2.4, arrow=True)
    d.text(x + 126, y + 5, "x right", color=COLORS[1])
    d.line(x, y, x, y + 92, COLORS[2], 2.4, arrow=True)
    d.text(x + 8, y + 98, "y down", color=COLORS[2])
    d.line(x, y, x + 82, y - 66, COLORS[0], 2.4, arrow=True)
    d.text(x + 88, y - 68, "z forward", color=COLORS[0])
    d.dot(x, y, 4)
    d.lines(24, 60, ["OpenCV axes; p_camera = viewmat p_world."], 11.5)
    d.lines(
        24,
        288,
        ["transforms.json (OpenGL: y up, z backward)", "is converted once, in its reader."],
        11.5,
    )

    d.text(330, 34, "Pixels", 16, bold=True)
    x, y, s = 372, 96, 52
    for row in range(3):
        for column in range(4):
            d.rect(x + column * s, y + row * s, s, s, "#f5f7fa" if (row + column) % 2 else PAPER)
            d.dot(x + (column + 0.5) * s, y + (row + 0.5) * s, 2.2, FAINT)
    d.dot(x + s / 2, y + s / 2, 4, COLORS[1])
    d.text(x + s / 2, y - 26, "first centre (0.5, 0.5)", 11.5, "middle", COLORS[1])
    d.line(x + s / 2, y - 21, x + s / 2, y + s / 2 - 6, COLORS[1])
    for k in range(5):
        d.text(x + k * s, y + 3 * s + 16, str(k), 11.5, "middle")
    for k in range(4):
        d.text(x - 8, y + k * s + 4, str(k), 11.5, "end")
    d.dot(x + 2 * s, y + 1.5 * s, 4, COLORS[0])
    d.text(x + 2 * s + 8, y + 1.5 * s - 6, "cx = W/2 = 2", 11.5, color=COLORS[0])
    d.text(330, 288, "Edges at integers, centres at +0.5, as COLMAP.", 11.5)
    d.text(330, 305, "OpenCV, KITTI: first centre 0, so theirs + 0.5 is ours.", 11.5)

    d.text(656, 34, "Images", 16, bold=True)
    y = 64
    boxes = (
        ("linear", "radiance L, no exposure", COLORS[0]),
        ("exposed", "e L: what reaches the sensor", COLORS[0]),
        ("ldr", "T(e L), may exceed 1", COLORS[4]),
        ("display", "values of an 8-bit file", COLORS[4]),
    )
    between = ("times the view's exposure e", "tone curve T with the view's gamma", "clamp")
    for k, (name, meaning, color) in enumerate(boxes):
        top = y + k * 64
        d.rect(656, top, 300, 36, color, INK, 0.16)
        d.text(668, top + 23, name, 14, bold=True)
        d.text(944, top + 23, meaning, 11, "end")
        if k < len(between):
            d.line(690, top + 38, 690, top + 60, arrow=True)
            d.text(702, top + 54, between[k], 11)
    return d


# ------------------------------------------------------------------ the package

ROOT = Path(__file__).resolve().parents[2]


def layers() -> list[list[str]]:
    """Return the packages and modules in the order in which they may import, top to bottom."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    (contract,) = [
        c for c in settings["tool"]["importlinter"]["contracts"] if c["type"] == "layers"
    ]
    return [[name.strip() for name in layer.split(":")] for layer in contract["layers"]]


def described(name: str) -> str:
    """Return the first sentence of a package or module."""
    folder = ROOT / "p2gs_jax" / name
    head = folder / "__init__.py" if folder.is_dir() else folder.with_suffix(".py")
    words = ast.get_docstring(ast.parse(head.read_text(encoding="utf-8"))) or ""
    return words.split("\n\n")[0].replace("\n", " ")


def architecture() -> Drawing:
    rows = layers()
    count = sum(map(len, rows))
    d = Drawing(980, 60 + 24 * count + 14 * len(rows), "The packages of p2gs_jax")
    d.text(24, 34, "Imports run downwards", 16, bold=True)
    y = 50.0
    for k, row in enumerate(rows):
        height = 24 * len(row) + 4
        d.rect(24, y, 932, height, COLORS[k % len(COLORS)], "none", 0.12)
        for i, name in enumerate(row):
            words = described(name)
            at = y + 18 + 24 * i
            d.text(36, at, name, 13, bold=True)
            d.text(176, at, words if len(words) < 118 else words[:115].rstrip() + " ...", 11.5)
        y += height + 10
    return d


DRAWINGS = {"kernel": kernel, "axes": axes, "architecture": architecture}

if __name__ == "__main__":
    for name, draw in DRAWINGS.items():
        draw().save(Path(__file__).parent / f"{name}.svg")
