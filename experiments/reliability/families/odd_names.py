"""Names of files that try to leave the scene, the page or the terminal."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from reliability import scenes
from reliability.family import Family, Report
from reliability.reading import read
from reliability.trials import Trial, run_trials

NAME = "odd_names"
ABOUT = """Names with blanks, quotes, HTML, markup, control characters, other scripts and no
UTF-8, and names that lead out of the scene or in circles. Nothing outside of the scene is read
unless the user named it, nothing outside of --out is written, and a terminal gets no control
characters."""
ODD = {
    "blanks": " a  b .png",
    "quotes": 'it\'s "quoted".png',
    "HTML": "<img src=x onerror=alert(1)>.png",
    "script": "<script>alert(1)<|script>.png",
    "entity": "&lt;b&gt;.png",
    "ANSI colour": "\x1b[31mred\x1b[0m.png",
    "ANSI title": "\x1b]0;title\x07.png",
    "C1": "\x9b31mred.png",
    "newline": "two\nlines.png",
    "tab": "a\tb.png",
    "carriage return": "good\rbad.png",
    "right to left": "\u202egnp.exe.png",
    "markup": "[bold red]x[/bold red].png",
    "unbalanced markup": "[/nothing].png",
    "emoji": ":smile:\U0001f600.png",
    "shell": "$(touch hacked);`touch hacked`.png",
    "option": "--help.png",
    "percent": "%s%n{}{0}.png",
    "template": "{{7*7}}${7*7}.png",
    "long": "x" * 240 + ".png",
    "Greek": "φωτογραφία.png",
    "Chinese": "照片.png",
    "decomposed": "e\u0301.png",
    "no UTF-8": os.fsdecode(b"\xff\xfe.png"),
    "trailing dot": "a..png",
    "reserved": "CON.png",
    "formula": "=cmd|'1'!A1.png",
    "glob": "[a-z]*?.png",
    "comment": "#hash.png",
    "hidden": ".hidden.png",
    "backslash": "a\\..\\..\\b.png",
}
OUTSIDE = {
    "parent": "../../secret.png",
    "parent of the images": "../secret.png",
    "there and back": "a/../../../secret.png",
    "absolute": "ABSOLUTE",
    "backslashes": "..\\..\\secret.png",
    "device": "/dev/zero",
    "process": "/proc/self/mem",
}


def run(quick: bool, out: Path, report: Report) -> Family:
    """Try all; `quick`: every fourth."""
    return run_trials(NAME, list(trials())[:: 4 if quick else 1], out, report)


def trials() -> Iterator[Trial]:
    """Yield all, in their order."""
    for name, odd in ODD.items():
        yield Trial(f"photograph: {name}", partial(with_photograph, odd), read)
        yield Trial(f"camera: {name}", partial(_camera, odd.removesuffix(".png")), read)
        yield Trial(f"scene folder: {name}", partial(_folder, odd), read)
        yield Trial(
            f"missing photograph: {name}", partial(_named_in_transforms, odd), read, refused=True
        )
    for name, outside in OUTSIDE.items():
        yield Trial(f"model: {name}", partial(_colmap_names, outside), read, refused=True)
        yield Trial(
            f"transforms: {name}", partial(_named_in_transforms, outside), read, refused=True
        )
        for key in ("mask_path", "ply_file_path"):
            yield Trial(f"{key}: {name}", partial(_key, key, outside), read, refused=True)
    yield Trial("images lead to themselves", partial(_loop, "images"), read, refused=True)
    yield Trial("a photograph leads to itself", partial(_loop, f"images/{scenes.names()[1]}"), read)
    yield Trial("masks lead to themselves", partial(_loop, "masks"), read)
    yield Trial("a model leads to itself", partial(_loop, "sparse"), read)
    yield Trial("a folder of images holds itself", _inside_itself, read)
    yield Trial("photographs alone in a folder that holds itself", _alone_inside_itself, read)
    yield Trial(
        "a photograph is a folder", partial(_of_kind, lambda p: p.mkdir()), read, refused=True
    )
    yield Trial("a photograph is a pipe", partial(_of_kind, os.mkfifo), read, refused=True)
    yield Trial("the model is a pipe", _model_is_a_pipe, read, refused=True)


def with_photograph(odd: str, root: Path) -> None:
    """Make a scene of which one photograph has a name."""
    scenes.write_transforms(root)
    odd_path = root / "images" / odd
    odd_path.parent.mkdir(exist_ok=True)
    (root / "images" / scenes.names()[1]).rename(odd_path)
    said = scenes.transforms()
    said["train_filenames"] = said["test_filenames"] = None
    said["frames"][1]["file_path"] = f"images/{odd}"
    (root / "transforms.json").write_text(json.dumps(said))


def _camera(odd: str, root: Path) -> None:
    scenes.write_transforms(root)
    place = root / "images" / odd.replace("/", "|")
    place.mkdir()
    said = json.loads((root / "transforms.json").read_text())
    frame = said["frames"][0]
    photograph = root / frame["file_path"]
    photograph.rename(place / photograph.name)
    frame["file_path"] = f"images/{place.name}/{photograph.name}"
    (root / "transforms.json").write_text(json.dumps(said))


def _folder(odd: str, root: Path) -> Path:
    scenes.write_colmap(root / odd)
    (root / odd / "sparse" / "0" / "cameras.bin").write_bytes(b"")
    return root / odd


def _named_in_transforms(odd: str, root: Path) -> None:
    scenes.write_transforms(root)
    said = scenes.transforms()
    said["frames"][1]["file_path"] = _secret(root, odd)
    del said["train_filenames"], said["test_filenames"]
    (root / "transforms.json").write_text(json.dumps(said))


def _key(key: str, outside: str, root: Path) -> None:
    scenes.write_transforms(root)
    said = scenes.transforms()
    said[key] = _secret(root, outside)
    (root / "transforms.json").write_text(json.dumps(said))


def _colmap_names(outside: str, root: Path) -> None:
    model = scenes.write_colmap(root, text=True)
    name = _secret(root, outside)
    text = (model / "images.txt").read_text().replace(scenes.names()[1], name)
    (model / "images.txt").write_text(text)


def _secret(root: Path, name: str) -> str:
    """Put a photograph where the names lead, outside of the scene; return the name."""
    whole = root / "images" / scenes.names()[0]
    secret = root.parent / "secret.png"
    secret.write_bytes(whole.read_bytes())
    (root / "secret.png").write_bytes(whole.read_bytes())
    return str(secret) if name == "ABSOLUTE" else name


def _loop(place: str, root: Path) -> None:
    scenes.write_colmap(root)
    path = root / place
    if path.is_dir():
        path.rename(root / "elsewhere")
    path.unlink(missing_ok=True)
    path.symlink_to(path.name)


def _inside_itself(root: Path) -> None:
    scenes.write_colmap(root)
    (root / "images" / "again").symlink_to(".")


def _alone_inside_itself(root: Path) -> None:
    scenes.write_photographs(root / "images")
    (root / "images" / "again").symlink_to("..")


def _of_kind(become: Callable[[Path], object], root: Path) -> None:
    scenes.write_colmap(root)
    path = root / "images" / scenes.names()[1]
    path.unlink()
    become(path)


def _model_is_a_pipe(root: Path) -> None:
    model = scenes.write_colmap(root)
    (model / "points3D.bin").unlink()
    os.mkfifo(model / "points3D.bin")
