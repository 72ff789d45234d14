"""Photographs of every kind, size and state."""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
from PIL import Image
from reliability import pictures, scenes
from reliability.family import Family, Report
from reliability.mutations import Broken, cuts, flips, random_bytes
from reliability.reading import read
from reliability.trials import Trial, run_trials

NAME = "broken_photographs"
ABOUT = """Photographs from 1x1 to 20,000x20,000 pixels, decompression bombs, CMYK, palettes,
1 to 32 bits, animated, with alpha, empty, cut, flipped, of noise, and with broken EXIF. Each is
read whole, or refused with code 2 by a message that names file, fault and remedy, within 30 s and
2 GB."""
SEED = 20261124
SPACING = 4
SIZE = (scenes.WIDTH, scenes.HEIGHT)
DEVELOPED = ("heic", "dng", "cr2", "nef", "exr")


def run(quick: bool, out: Path, report: Report) -> Family:
    """Try all; `quick`: every fourth."""
    return run_trials(NAME, list(trials())[:: SPACING if quick else 1], out, report)


def trials() -> Iterator[Trial]:
    """Yield all, in their order."""
    yield from _sizes()
    yield from _bombs()
    yield from _kinds()
    yield from _broken()
    yield from _exif()


def _among(data: Callable[[], bytes], suffix: str, size: tuple[int, int], root: Path) -> None:
    """Make a scene of which one photograph is another, whose size is known."""
    scenes.write_photographs(root / "images")
    (root / "images" / scenes.names()[1]).unlink()
    name = f"000001.{suffix}"
    (root / "images" / name).write_bytes(data())
    said = scenes.transforms()
    for key in ("train_filenames", "test_filenames", "ply_file_path"):
        del said[key]
    width, height = size
    said["frames"][1] |= {"file_path": f"images/{name}", "w": width, "h": height}
    said["frames"][1] |= {"cx": width / 2, "cy": height / 2}
    (root / "transforms.json").write_text(json.dumps(said))


def _alone(data: Callable[[], bytes], suffix: str, root: Path) -> None:
    scenes.write_photographs(root / "images")
    (root / "images" / f"more.{suffix}").write_bytes(data())


def _mask(data: Callable[[], bytes], root: Path) -> None:
    scenes.write_colmap(root)
    (root / "masks").mkdir()
    (root / "masks" / scenes.names()[1]).write_bytes(data())


def _sizes() -> Iterator[Trial]:
    for width, height in ((1, 1), (1, 40), (40, 1), (2, 3), (4097, 3), (3000, 2000)):
        for kind in ("png", "jpg"):
            yield Trial(
                f"size: {width}x{height}.{kind}",
                partial(_among, _noise(width, height, kind), kind, (width, height)),
                read,
                refused=False,
            )


def _noise(width: int, height: int, kind: str) -> Callable[[], bytes]:
    return lambda: pictures.encoded(pictures.noise(width, height), kind)


def _bombs() -> Iterator[Trial]:
    sides = {"20,000x20,000": (20_000, 20_000), "13,000x13,000": (13_000, 13_000)}
    for name, size in sides.items():
        for depth, colour in ((1, 0), (8, 0), (1, 3), (8, 2)):
            if colour == 2 and size[0] > 13_000:
                continue
            data = partial(pictures.black_png, *size, depth, colour)
            said = f"{name}, {depth} bits, kind {colour}"
            yield Trial(f"bomb: {said}", partial(_among, data, "png", size), read)
            yield Trial(f"bomb as a mask: {said}", partial(_mask, data), read)
        yield Trial(
            f"bomb alone: {name}",
            partial(_alone, partial(pictures.black_png, *size, 1, 0), "png"),
            read,
        )
    for size in ((20_000, 20_000), (60_000, 60_000), (2**31 - 1, 2**31 - 1), (0, 0)):
        for suffix, broken in pictures.only_headers(*size):
            make = partial(_among, _held(broken.data), suffix, size if size[0] else (1, 1))
            yield Trial(f"bomb: {broken.name}.{suffix}", make, read, refused=True)
    for size in (2**20, 2**30):
        for name, kind in (("profile", b"iCCP"), ("comment", b"zTXt")):
            yield Trial(
                f"a {name} of {size} zeros",
                partial(_among, partial(pictures.bomb, kind, size), "png", SIZE),
                read,
            )


def _held(data: bytes) -> Callable[[], bytes]:
    return lambda: data


def _kinds() -> Iterator[Trial]:
    rgb, grey = pictures.noise(*SIZE), pictures.noise(*SIZE, 1)
    alpha = pictures.noise(*SIZE, 4)
    frames = [pictures.noise(*SIZE, seed=k) for k in range(3)]
    several = {"save_all": True, "append_images": frames[1:]}
    deep = Image.fromarray(np.asarray(grey).astype(np.uint16) * 257)
    floating = Image.fromarray(np.asarray(grey).astype(np.float32) / 255)
    made = {
        "CMYK.jpg": pictures.encoded(rgb.convert("CMYK"), "jpg"),
        "CMYK.tif": pictures.encoded(rgb.convert("CMYK"), "tif"),
        "YCbCr.tif": pictures.encoded(rgb.convert("YCbCr"), "tif"),
        "Lab.tif": pictures.encoded(rgb.convert("LAB"), "tif"),
        "palette.png": pictures.encoded(rgb.convert("P"), "png"),
        "palette, transparent.png": pictures.encoded(rgb.convert("P"), "png", transparency=3),
        "palette.tif": pictures.encoded(rgb.convert("P"), "tif"),
        "palette.bmp": pictures.encoded(rgb.convert("P"), "bmp"),
        "one bit.png": pictures.encoded(rgb.convert("1"), "png"),
        "one bit.tif": pictures.encoded(rgb.convert("1"), "tif", compression="group4"),
        "grey.jpg": pictures.encoded(grey, "jpg"),
        "grey with alpha.png": pictures.encoded(rgb.convert("LA"), "png"),
        "alpha.png": pictures.encoded(alpha, "png"),
        "alpha.webp": pictures.encoded(alpha, "webp"),
        "alpha.tif": pictures.encoded(alpha, "tif"),
        "16 bits.png": pictures.encoded(deep, "png"),
        "16 bits.tif": pictures.encoded(deep, "tif"),
        "32 bits.tif": pictures.encoded(grey.convert("I"), "tif"),
        "floats.tif": pictures.encoded(floating, "tif"),
        "animated.png": pictures.encoded(frames[0], "png", **several),
        "animated.webp": pictures.encoded(frames[0], "webp", **several),
        "pages.tif": pictures.encoded(frames[0], "tif", **several),
        "GIF called.png": pictures.encoded(rgb, "gif"),
        "JPEG called.png": pictures.encoded(rgb, "jpg"),
        "PNG called.jpg": pictures.encoded(rgb, "png"),
        "PNG called.heic": pictures.encoded(rgb, "png"),
        "progressive.jpg": pictures.encoded(rgb, "jpg", progressive=True),
        "text called.jpg": b"no photograph at all\n",
        "page called.png": b"<html><script>alert(1)</script></html>",
        "vectors called.png": b"<svg xmlns='http://www.w3.org/2000/svg' width='48' height='32'/>",
        "PostScript called.png": b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 48 32\nshowpage\n",
    }
    for name, data in made.items():
        suffix = name.rsplit(".", 1)[1]
        yield Trial(f"kind: {name}", partial(_among, _held(data), suffix, SIZE), read)


def _broken() -> Iterator[Trial]:
    rng = np.random.default_rng(SEED)
    for kind in pictures.KINDS:
        data = pictures.encoded(pictures.noise(*SIZE), kind)
        for broken in (*cuts(data, rng, 8), *flips(data[:200], rng, 12)):
            whole = broken.data if "cut" in broken.name else broken.data + data[200:]
            yield Trial(f"{kind}: {broken.name}", partial(_among, _held(whole), kind, SIZE), read)
        yield Trial(
            f"{kind}: twice over",
            partial(_among, _held(data + data), kind, SIZE),
            read,
            refused=False,
        )
    for kind in (*pictures.KINDS, *DEVELOPED):
        for broken in random_bytes(rng):
            yield Trial(
                f"{kind}: {broken.name}",
                partial(_among, _held(broken.data), kind, SIZE),
                read,
                refused=True,
            )
        yield Trial(
            f"{kind} alone: noise",
            partial(_alone, _held(rng.bytes(4096)), kind),
            read,
            refused=True,
        )


def _exif() -> Iterator[Trial]:
    rng = np.random.default_rng(SEED + 1)
    data = pictures.with_exif(*SIZE)
    start = data.index(b"Exif\0\0")
    size = struct.unpack(">H", data[start - 2 : start])[0]
    exif, rest = data[start : start + size], data[start + size :]
    for broken in (*flips(exif, rng, 60), *_numbers(exif)):
        whole = data[:start] + broken.data + rest
        yield Trial(
            f"EXIF: {broken.name}", partial(_among, _held(whole), "jpg", SIZE), read, refused=False
        )
    png = io.BytesIO()
    pictures.noise(*SIZE).save(png, "png")
    for broken in random_bytes(rng):
        whole = pictures.with_chunk(png.getvalue(), b"eXIf", broken.data)
        yield Trial(
            f"EXIF of a PNG: {broken.name}", partial(_among, _held(whole), "png", SIZE), read
        )
        profile = pictures.encoded(pictures.noise(*SIZE), "png", icc_profile=broken.data or b"x")
        yield Trial(f"profile: {broken.name}", partial(_among, _held(profile), "png", SIZE), read)


def _numbers(exif: bytes) -> Iterator[Broken]:
    """Put extreme 4-byte numbers at every twelfth byte."""
    for at in range(8, len(exif) - 4, 12):
        for value in (0, 0xFFFFFFFF):
            other = exif[:at] + struct.pack(">I", value) + exif[at + 4 :]
            yield Broken(f"word {at} is {value}", other)
