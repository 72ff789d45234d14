"""Whether the libraries that everything needs can be imported, and are new enough."""

from __future__ import annotations

import importlib
import importlib.metadata
from dataclasses import dataclass

# Distributions and what they are imported as: the dependencies of pyproject.toml.
NEEDED = {
    "jax": "jax",
    "jaxlib": "jaxlib",
    "optax": "optax",
    "optimistix": "optimistix",
    "equinox": "equinox",
    "jaxtyping": "jaxtyping",
    "numpy": "numpy",
    "scipy": "scipy",
    "OpenEXR": "OpenEXR",
    "colour-science": "colour",
    "opencv-contrib-python-headless": "cv2",
    "pycolmap": "pycolmap",
    "chex": "chex",
    "tyro": "tyro",
    "platformdirs": "platformdirs",
    "filelock": "filelock",
    "rich": "rich",
    "orbax-checkpoint": "orbax.checkpoint",
    "plyfile": "plyfile",
    "pillow": "PIL",
    "matplotlib": "matplotlib",
}


@dataclass(frozen=True)
class Library:
    """One library.

    Attributes:
        name: as pip knows it.
        version: None where pip does not know it.
        trouble: why it cannot be used, or None.
    """

    name: str
    version: str | None
    trouble: str | None


def look(needed: dict[str, str] = NEEDED) -> list[Library]:
    """Try to import every library; never raises.

    Args:
        needed: modules by distribution.
    """
    wanted = _requirements()
    return [_try(name, module, wanted.get(name.lower())) for name, module in needed.items()]


def _try(name: str, module: str, wanted) -> Library:
    version = installed(name)
    try:
        loaded = importlib.import_module(module)
    except Exception as error:  # whatever a broken library raises
        reason = str(error).strip().splitlines()
        return Library(name, version, f"{type(error).__name__}: {reason[0] if reason else module}")
    version = version or getattr(loaded, "__version__", None)
    if wanted is not None and version is not None and not wanted.contains(version, True):
        return Library(name, version, f"too old: {name}{wanted} is needed")
    return Library(name, version, None)


def installed(name: str) -> str | None:
    """Return the version of a distribution, or None where it is not installed."""
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def _requirements() -> dict:
    """Return version ranges by distribution, in lower case; empty where they cannot be told."""
    try:
        from packaging.requirements import Requirement

        lines = importlib.metadata.requires("p2gs-jax") or []
        found = (Requirement(line) for line in lines)
        return {r.name.lower(): r.specifier for r in found if r.marker is None}
    except Exception:  # a hint only
        return {}
