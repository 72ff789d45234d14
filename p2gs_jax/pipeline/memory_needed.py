"""What memory a fit will take, told before it begins: a fit that dies after an hour helps nobody.

A model from above, measured on fits of 1,000 and 300,000 Gaussians: programs and libraries, so much
for every parameter of a Gaussian, for every pixel of the largest view and for every pixel of the
photographs that are kept decoded. On a GPU Gaussians and the pixels of a view are the device's, and
are not foretold.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import NamedTuple

import jax

from p2gs_jax.config import FitConfig
from p2gs_jax.core.memory import left_to_process, ran_out, resident
from p2gs_jax.errors import UserError
from p2gs_jax.gaussians.dense import seed_bound
from p2gs_jax.gaussians.population import Coverage
from p2gs_jax.scene.pixels.store import size_at
from p2gs_jax.types import Scene

# Bytes.
OF_PROGRAMS = 0.8e9
A_PARAMETER = 37  # with its moments, gradient and the copies of a densification
A_PIXEL = 650
A_PHOTOGRAPH_PIXEL = 7
FEWEST_GAUSSIANS = 1000
OPTIONS = "--gaussians, --max-width or --data.cache-mb"


class MemoryNeeded(NamedTuple):
    """Bytes that a fit takes at its peak.

    Attributes:
        programs: Python, libraries, compiling.
        gaussians: parameters, moments, gradients, of the largest population.
        photographs: decoded and kept.
        view: pictures of the largest view and their gradients.
        population: the largest there may be.
    """

    programs: float
    gaussians: float
    photographs: float
    view: float
    population: int

    @property
    def total(self) -> float:
        """Of all parts."""
        return self.programs + self.gaussians + self.photographs + self.view


def memory_needed(scene: Scene, cfg: FitConfig, coverage: Coverage) -> MemoryNeeded:
    """Return what a fit will take.

    Args:
        scene: views and points.
        cfg: as asked.
        coverage: how much of the scene the views show.
    """
    count = max(seed_bound(cfg, min(len(scene.points), cfg.init.max_seeds), coverage), 1)
    parameters = 11 + 3 * (cfg.render.sh_degree + 1) ** 2
    here = jax.default_backend() == "cpu"
    sizes = [size_at(view, cfg.data.max_width) for view in scene.views]
    decoded = sum(w * h for w, h in sizes) * A_PHOTOGRAPH_PIXEL
    return MemoryNeeded(
        programs=OF_PROGRAMS,
        gaussians=float(here * count * parameters * A_PARAMETER),
        photographs=float(min(decoded, cfg.data.cache_mb * 2**20)),
        view=float(here * coverage.pixels * A_PIXEL),
        population=count,
    )


def require_memory(needed: MemoryNeeded) -> None:
    """Refuse a fit that will not find its memory.

    Args:
        needed: from `memory_needed`.

    Raises:
        UserError: more is needed than is left; names the option that helps.
    """
    left = left_to_process()
    if left is None or needed.total <= left + resident():
        return
    room = left + resident()
    raise UserError(
        f"this fit would take about {_gb(needed.total)} of memory at its peak ({needed.population} "
        f"Gaussians {_gb(needed.gaussians)}, photographs {_gb(needed.photographs)}, pixels of a "
        f"view {_gb(needed.view)}, programs {_gb(needed.programs)}), and there are {_gb(room)}.",
        fix=_way_on(needed, room),
    )


@contextlib.contextmanager
def memory_named() -> Iterator[None]:
    """Let memory that runs out in a `with` block say what helps.

    Raises:
        UserError: it ran out. Other errors stay as they are.
    """
    try:
        yield
    except (MemoryError, RuntimeError, OSError) as error:
        if not ran_out(error):
            raise
        said = str(error).splitlines()[0][:160] if str(error) else "an allocation failed"
        raise UserError(
            f"memory ran out ({said}).",
            fix=f"lower {OPTIONS}, in a new folder, or end other programs and add --resume",
        ) from error


def _way_on(needed: MemoryNeeded, room: float) -> str:
    """Return which option brings a fit into the room there is, the largest part's first."""
    ways = {
        "gaussians": (needed.gaussians, "--gaussians {}", needed.population, FEWEST_GAUSSIANS),
        "photographs": (needed.photographs, "--data.cache-mb {}", needed.photographs / 2**20, 1),
    }
    for part, option, now, least in sorted(ways.values(), key=lambda way: -way[0]):
        share = 1 - (needed.total - room) / part if part else 0.0
        if share * now >= least:
            return f"add {option.format(_rounded(share * now))}, or end other programs"
    return f"lower {OPTIONS}, or end other programs"


def _rounded(value: float) -> int:
    """Return a whole number of two digits, not above."""
    step = 10 ** max(len(str(int(value))) - 2, 0)
    return int(value) // step * step


def _gb(size: float) -> str:
    return f"{size / 1e9:.1f} GB"
