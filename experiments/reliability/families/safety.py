"""Attacks through files from others, or from the same network."""

from __future__ import annotations

import ast
import os
import pickle
import re
import shutil
import sys
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
from reliability import scenes
from reliability.families.odd_names import with_photograph
from reliability.family import Family, Report
from reliability.reading import FIT, command, read
from reliability.trials import REFUSED, Trial, run_trials

from p2gs_jax.scene.drives.tables import read_pickled

NAME = "safety"
ABOUT = """By default the viewer listens on loopback. It refuses pages of other sites and foreign
host names that resolve to this machine, and needs a token if others can reach it. Reports hold no
script and escape names. Pickles that call a function are refused, temporary files are private, and
the package never runs strings as code. A trial is survived if nothing forbidden happens."""
PACKAGE = Path(__file__).resolve().parents[3] / "p2gs_jax"
HAPPENED = 71  # exit code of a child that did something forbidden
HTML = "<img src=x onerror=alert(1)>.png"
SLOW = {"seconds": 120.0, "data": 8 * 2**30}  # limits in seconds and bytes
LOOPBACK, SECRET = "127.0.0.1", "secret"


def run(quick: bool, out: Path, report: Report) -> Family:
    """Run the trials; `quick`: without the fit."""
    found = [t for t in trials() if not (quick and t.seconds > 100)]
    return run_trials(NAME, found, out, report)


def trials() -> Iterator[Trial]:
    """Yield all, in their order."""
    yield from _viewer()
    yield from _pickles()
    yield Trial("temporary files are private", _nothing, _temporary_files)
    yield Trial("no string runs as code, no free unpickling", _nothing, _forbidden_calls)
    yield Trial(
        "a report of hostile names", partial(with_photograph, HTML), _report, refused=False, **SLOW
    )


def _nothing(root: Path) -> Path:
    return root


def forbidden(condition: bool, what: str) -> int:
    """Return the exit code: HAPPENED, after printing `what`, if the condition holds, or else 0."""
    if condition:
        print(f"it happened: {what}", file=sys.stderr)
    return HAPPENED if condition else 0


def _viewer() -> Iterator[Trial]:
    evil = {"Origin": "http://evil.example"}
    asked: dict[str, tuple[bool, str, dict[str, str], bool]] = {
        "its own page": (False, "/", {}, True),
        "its own origin": (False, "/", {"Origin": "http://{address}"}, True),
        "another site": (False, "/", evil, False),
        "another port": (False, "/", {"Origin": "http://127.0.0.1:1"}, False),
        "an opaque origin": (False, "/", {"Origin": "null"}, False),
        "another scheme": (False, "/", {"Origin": "file://"}, False),
        "a name that points here": (False, "/", {"Host": "evil.example"}, False),
        "a name that begins alike": (False, "/", {"Host": "127.0.0.1.evil.example"}, False),
        "a file above": (False, "/../../../../etc/passwd", {}, False),
        "a file above, percent-encoded": (False, "/%2e%2e/%2e%2e/%2e%2e/etc/passwd", {}, False),
        "outside, without token": (True, "/", {}, False),
        "outside, empty token": (True, "/?token=", {}, False),
        "outside, wrong token": (True, "/?token=secreT", {}, False),
        "outside, token": (True, f"/?token={SECRET}", {}, True),
        "outside, cookie": (True, "/", {"Cookie": f"p2gs_jax_token_{{port}}={SECRET}"}, True),
        "outside, token and another site": (True, f"/?token={SECRET}", evil, False),
    }
    for name, (outside, path, headers, served) in asked.items():
        act = partial(_asks, outside, path, headers, served)
        yield Trial(f"viewer: {name}", _nothing, act, seconds=60)
    yield Trial("viewer: the address it listens on", _nothing, _listens)


def _asks(outside: bool, path: str, headers: dict[str, str], served: bool, root: Path) -> int:
    import viser

    from p2gs_jax.viewer.server import Guard, guard_of, guarded

    guard = Guard(None, SECRET) if outside else guard_of(LOOPBACK)
    with guarded(guard):
        server = viser.ViserServer(host=LOOPBACK, port=0, verbose=False)
    port = server.get_port()
    address = f"{LOOPBACK}:{port}"
    sent = {key: value.format(address=address, port=port) for key, value in headers.items()}
    request = urllib.request.Request(f"http://{address}{path}", headers=sent)
    try:
        with urllib.request.urlopen(request, timeout=20) as answer:
            found = answer.status == 200
    except urllib.error.HTTPError:
        found = False
    return forbidden(found != served, f"served: {found}")


def _listens(root: Path) -> int:
    from p2gs_jax.cli.pages import View
    from p2gs_jax.viewer.server import guard_of, is_loopback

    host = View(run=root).host
    return forbidden(not is_loopback(host) or guard_of("0.0.0.0").token is None, f"open: {host}")


class _Evil:
    """Makes a folder when it is unpickled."""

    def __init__(self, marker: str):
        self.marker = marker

    def __reduce__(self):
        return os.mkdir, (self.marker,)


def _pickles() -> Iterator[Trial]:
    places = ("poses_bounds.npy", "scene.npz", "table.pkl", "table.pkl.gz")
    for place in places:
        yield Trial(f"pickle: {place}", partial(_evil, place), partial(_opened, place), seconds=60)


def _evil(place: str, root: Path) -> None:
    import gzip

    evil = _Evil(str(root.parent / "elsewhere" / "unpickled"))
    array = np.array([evil], object)
    scenes.write_photographs(root / "images")
    path = root / place
    if place.endswith(".npy"):
        np.save(path, array, allow_pickle=True)
    elif place.endswith(".npz"):
        np.savez(path, json=array)
    elif place.endswith(".gz"):
        path.write_bytes(gzip.compress(pickle.dumps(evil)))
    else:
        path.write_bytes(pickle.dumps(evil))


def _opened(place: str, root: Path) -> int:
    path = root / place
    if place.endswith(".npy"):
        code = read(root)
    elif place == "scene.npz":
        code = _as_run(root)
    else:
        code = _table(path)
    return forbidden(Path("unpickled").exists(), "unpickled") or code


def _as_run(root: Path) -> int:
    from p2gs_jax.errors import UserError
    from p2gs_jax.run.scene_file import read_scene

    return _refusal(lambda: read_scene(root, root), UserError)


def _table(path: Path) -> int:
    from p2gs_jax.errors import UserError

    return _refusal(lambda: read_pickled(path), UserError)


def _refusal(act: Callable[[], object], kind: type[Exception]) -> int:
    try:
        act()
    except kind as error:
        print(error, file=sys.stderr)
        return REFUSED
    return 0


def _temporary_files(root: Path) -> int:
    """Write a file and a folder under an open umask, and look at them while they are written."""
    from p2gs_jax.core.atomic import atomic_folder, atomic_write

    os.umask(0)
    with atomic_write(root / "file") as file, atomic_folder(root / "folder") as folder:
        open_to_others = (file.stat().st_mode | folder.stat().st_mode) & 0o077
    shutil.rmtree(root / "folder")
    (root / "file").unlink()
    return forbidden(bool(open_to_others), "others can read temporary files")


def unsafe_calls(package: Path) -> list[str]:
    """Return the calls in a package that run strings as code, unpickle, or name temporary files."""
    bad = re.compile(
        r"^(eval|exec|os\.system|os\.popen|pickle\.loads?|marshal\.loads?|tempfile\.mktemp|"
        r"yaml\.load|shelve\.open|joblib\.load|torch\.load)$"
    )
    found = []
    for path in sorted(package.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.Call):
                continue
            name = ast.unparse(node.func)
            words = {k.arg: ast.unparse(k.value) for k in node.keywords}
            free = name == "np.load" and words.get("allow_pickle") != "False"
            if bad.match(name) or free or words.get("shell") == "True":
                found.append(f"{path.relative_to(package)}: {name}")
    return found


def _forbidden_calls(root: Path) -> int:
    found = unsafe_calls(PACKAGE)
    return forbidden(bool(found), ", ".join(found))


def _report(root: Path) -> int:
    """Fit photographs with hostile names, and look at the report."""
    run = root.parent / "run"
    try:
        code = command("fit", root, "--out", run, *FIT) or command("report", run)
        pages = [p.read_text(encoding="utf-8") for p in run.glob("*.html")]
        bad = [
            word for word in ("<script", "<img src=x", "javascript:") for p in pages if word in p
        ]
        attributes = [m for p in pages for m in re.findall(r"<[^<>]*\son\w+\s*=", p)]
        if code == 0 and not pages:
            return forbidden(True, "no report was written")
        return code or forbidden(bool(bad or attributes), f"in a report: {bad}, {attributes}")
    finally:
        shutil.rmtree(run, ignore_errors=True)
