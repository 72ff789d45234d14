"""`p2gs-jax doctor`: plain text, as the libraries for tables may be the broken ones."""

from __future__ import annotations

import dataclasses
import json
import platform
import sys
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING

from p2gs_jax.doctor import cache, features, libraries, machine, render

if TYPE_CHECKING:  # options need tyro, which may be what is broken
    from p2gs_jax.cli.options.setup import Doctor


def run(options: Doctor) -> int:
    """Print what works here; 1 where something that everything needs is broken."""
    return diagnose(as_json=options.json, self_test=not options.skip_self_test)


def diagnose(*, as_json: bool, self_test: bool = True) -> int:
    """Examine this machine and print the result; never raises.

    Args:
        as_json: print JSON instead of text.
        self_test: render three Gaussians as well.
    """
    if sys.stderr.isatty():
        then = ", then three Gaussians" if self_test else ""
        print(f"Trying every library{then} ...", file=sys.stderr)
    found = examine(self_test=self_test)
    print(json.dumps(found, indent=2) if as_json else as_text(found))
    return 0 if found["healthy"] else 1


def examine(*, self_test: bool = True) -> dict:
    """Return the state of this machine, as plain values.

    Args:
        self_test: render three Gaussians as well.
    """
    tried = libraries.check_libraries()
    devices = render.inspect_devices()
    kept = cache.inspect_cache()
    test = render.self_test() if self_test else render.SelfTest(None, "skipped")
    return {
        "p2gs_jax": libraries.installed("p2gs-jax"),
        "python": platform.python_version(),
        "machine": dataclasses.asdict(machine.inspect_machine(Path.cwd())),
        "devices": dataclasses.asdict(devices),
        "compile_cache": dataclasses.asdict(kept),
        "self_test": dataclasses.asdict(test),
        "libraries": [dataclasses.asdict(x) for x in tried],
        "optional": {
            name: libraries.installed(name)
            for name in features.OPTIONAL
            if name not in {x.name for x in tried}
        },
        "features": [dataclasses.asdict(f) for f in features.list_features(tried, devices.backend)],
        "healthy": test.ok is not False
        and devices.trouble is None
        and not any(x.trouble for x in tried),
    }


def as_text(found: dict) -> str:
    """Return what `examine` found as text of at most 80 columns, but for paths and errors."""
    m, d, c, t = (found[k] for k in ("machine", "devices", "compile_cache", "self_test"))
    good = [f"{x['name']} {x['version']}" for x in found["libraries"] if not x["trouble"]]
    good += [f"{name} {version}" for name, version in found["optional"].items() if version]
    bad = [x for x in found["libraries"] if x["trouble"]]
    rows = [
        ("p2gs-jax", f"{found['p2gs_jax']}, Python {found['python']}, {m['system']}"),
        ("JAX runs on", d["trouble"] or ", ".join(d["names"])),
        ("Cores", str(m["cores"])),
        ("Memory", f"{_size(m['memory'])}, {_size(m['available'])} of it available"),
        ("Disk", f"{_size(m['free'])} free in {m['folder']}"),
        ("Compiled", c["remark"]),
        ("Rasterizer", f"{d['rasterizer']}, tile lists by {d['binning']}"),
        ("Self-test", _self_test(t)),
        ("Libraries", ", ".join(good)),
        *((f"  {x['name']}", f"BROKEN ({x['version']}): {x['trouble']}") for x in bad),
    ]
    width = max(len(f["name"]) for f in found["features"]) + 4
    lines = [_row(name, text, 13) for name, text in rows]
    lines += ["", "Feature".ljust(width) + "works"]
    for f in found["features"]:
        lines.append(
            _row(f"  {f['name']}", f"{'yes' if f['ready'] else 'no '}   {f['remark']}", width)
        )
    if found["healthy"]:
        verdict = "All that a fit needs is there."
    else:
        names = " ".join(f"'{x['name']}'" for x in bad)
        verdict = "Something that every fit needs is broken; see above." + (
            f"\nTry: pip install --upgrade --force-reinstall {names}" if names else ""
        )
    return "\n".join([*lines, "", verdict])


def _row(name: str, text: str, width: int) -> str:
    return textwrap.fill(
        text,
        80,
        initial_indent=name.ljust(width),
        subsequent_indent=" " * width,
        break_long_words=False,
        break_on_hyphens=False,
    )


def _self_test(test: dict) -> str:
    if test["ok"] is None:
        return test["remark"]
    if not test["ok"]:
        return f"FAILED: {test['remark']}"
    return (
        f"ok: {test['remark']} in {test['then_ms']:.1f} ms ({test['first_ms'] / 1e3:.1f} s the "
        f"first time), within {test['difference']:.0e} of the reference"
    )


def _size(count: int | None) -> str:
    return "unknown" if count is None else f"{count / 2**30:.1f} GiB"
