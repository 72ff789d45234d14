"""Whether the libraries that everything needs can be imported, and are new enough."""

from __future__ import annotations

import importlib
import importlib.metadata
from dataclasses import dataclass

# Import names that differ from the distribution's; pip may write names in lower case.
MODULES = {
    "colour-science": "colour",
    "openexr": "OpenEXR",
    "opencv-contrib-python-headless": "cv2",
    "orbax-checkpoint": "orbax.checkpoint",
    "pillow": "PIL",
}
# Checked where pip has no metadata of p2gs-jax: a copy that was never installed.
CORE = ("jax", "optax", "optimistix", "equinox", "jaxtyping", "numpy", "tyro", "rich", "pycolmap")


@dataclass(frozen=True)
class Library:
    """One library.

    Attributes:
        name: as pip knows it.
        version: None where pip does not know it.
        trouble: the error on import, or a version that is too old; None where it works.
    """

    name: str
    version: str | None
    trouble: str | None


def check_libraries() -> list[Library]:
    """Try to import everything that p2gs-jax depends on; never raises."""
    wanted = requirements()
    return [_try(name, wanted[name]) for name in sorted(wanted, key=str.lower)]


def _try(name: str, wanted) -> Library:
    version, module = installed(name), module_of(name)
    try:
        loaded = importlib.import_module(module)
    except Exception as error:  # whatever a broken library raises
        reason = str(error).strip().splitlines()
        return Library(name, version, f"{type(error).__name__}: {reason[0] if reason else module}")
    version = version or getattr(loaded, "__version__", None)
    if wanted is not None and version is not None and not wanted.contains(version, True):
        return Library(name, version, f"too old: {name}{wanted} is needed")
    return Library(name, version, None)


def module_of(name: str) -> str:
    """Return what a distribution is imported as."""
    return MODULES.get(name.lower(), name)


def installed(name: str) -> str | None:
    """Return the version of a distribution, or None where it is not installed."""
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def requirements() -> dict:
    """Return ranges of versions by distribution; None where unknown."""
    try:
        from packaging.requirements import Requirement

        lines = importlib.metadata.requires("p2gs-jax") or []
        needed = [r for r in map(Requirement, lines) if r.marker is None]
        return {r.name: r.specifier for r in needed} | {"jaxlib": None}
    except Exception:  # p2gs-jax is not installed, or packaging is not
        return dict.fromkeys((*CORE, "jaxlib"))
