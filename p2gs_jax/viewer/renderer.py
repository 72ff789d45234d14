"""The renderer, compiled for a few sizes in the background, so that frames never wait.

Every size needs a compiled program, so there are few sizes: six widths in a few aspect ratios.
Until the size of a canvas is compiled, a frame of another size is stretched over it. A frame whose
tile lists overflow is rendered at a smaller size while a program with longer lists is compiled.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import Future, ThreadPoolExecutor

import jax
import numpy as np
from jaxtyping import Array, Bool

from p2gs_jax.config import RenderConfig
from p2gs_jax.errors import UserError
from p2gs_jax.render import capacity
from p2gs_jax.types import Camera, Gaussians, Render
from p2gs_jax.viewer.camera import Size
from p2gs_jax.viewer.pictures import RenderedFrame

# Largest number of entries of a view's tile lists; a camera inside a splat may need any number.
MOST_ENTRIES = 2**26
# Widths of the sizes at an aspect of 16:10, pixels; each area is 2.25 times the previous one.
WIDTHS = (320, 480, 720, 1080, 1620, 2430)
# Aspect ratios per factor of two; pixels are then square within 9 %.
SHAPES_PER_OCTAVE = 4
ALIGN = 8  # widths and heights are multiples of this, pixels
# Sizes with more than this share of the full size's pixels would save too little time.
FULL_FROM = 0.6
# Target time of a frame while the camera moves, milliseconds.
TARGET_MS = 75.0
# The next larger size follows if its expected time is below the first share of the target time, and
# a smaller one if the last frame took more than the second.
ENLARGE_WITHIN, SHRINK_BEYOND = 0.85, 1.25


class Renderer:
    """Renders views of compiled sizes, and compiles others in a thread.

    All methods may be called from any thread; one frame is rendered at a time.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        alive: Bool[Array, " n"],
        cfg: RenderConfig,
        probes: Sequence[Callable[[Size], Camera]],
        on_change: Callable[[], None] = lambda: None,
        warm_up: Callable[[Render], object] = lambda result: None,
    ):
        """Start without a program; `alive` is the mask of the Gaussians to draw.

        New programs have room for the views of typical cameras (`probes`). `on_change` is called
        before and after a compilation. `warm_up` compiles the functions that use a new render.
        """
        self._scene, self._cfg, self._probes = (gaussians, alive), cfg, probes
        self._on_change, self._warm_up = on_change, warm_up
        self._render_any = capacity.make_renderer(cfg)
        self._jobs: dict[Size, Future[Callable[..., Render]]] = {}
        self._lock, self._one_frame = threading.RLock(), threading.Lock()
        self._compiler = ThreadPoolExecutor(1, "compile")

    def show(self, gaussians: Gaussians, alive: Bool[Array, " n"]) -> None:
        """Render other Gaussians from now on; a different number of them needs new programs."""
        with self._lock:
            stays = self._scene[0].capacity == gaussians.capacity
            self._scene = gaussians, alive
            if not stays:
                sizes, self._jobs = tuple(self._jobs), {}
                self.request(sizes)

    @property
    def ready(self) -> frozenset[Size]:
        """The compiled sizes."""
        with self._lock:
            return frozenset(s for s, job in self._jobs.items() if _succeeded(job))

    @property
    def compiling(self) -> Size | None:
        """The size that is being compiled, or None."""
        with self._lock:
            return next((size for size, job in self._jobs.items() if job.running()), None)

    @property
    def failure(self) -> str | None:
        """A message on a size that could not be compiled, or None."""
        with self._lock:
            for (width, height), job in self._jobs.items():
                if job.done() and (error := job.exception()) is not None:
                    return f"{width} x {height} cannot be compiled: {error}"
        return None

    def request(self, sizes: Sequence[Size]) -> None:
        """Compile these sizes in this order; cancel other sizes that still wait."""
        with self._lock:
            for size in [s for s in self._jobs if s not in sizes]:
                if self._jobs[size].cancel():
                    del self._jobs[size]
            for size in sizes:
                if size not in self._jobs:
                    self._submit(size, 0)

    def _submit(self, size: Size, needed: int) -> None:
        def done(job: Future) -> None:
            if not job.cancelled():
                self._on_change()

        job = self._jobs[size] = self._compiler.submit(self._compile, size, needed)
        job.add_done_callback(done)

    def render(self, camera: Camera) -> RenderedFrame | None:
        """Return a frame, or None if its size is not compiled or its tile lists overflow.

        After an overflow the size is not ready until a program with longer lists is compiled.
        """
        size = (camera.width, camera.height)
        with self._lock:
            job, scene = self._jobs.get(size), self._scene
        if job is None or not _succeeded(job):
            return None
        with self._one_frame:
            result = job.result()(*scene, camera)
            needed = int(result.count)
        if not bool(result.overflow):
            return _frame(result, camera)
        with self._lock:
            if needed <= MOST_ENTRIES and self._jobs.get(size) is job:
                self._submit(size, needed)
        return None

    def render_now(self, camera: Camera) -> RenderedFrame:
        """Return a frame of any size; compiling its program may take long.

        Raises a UserError if its tile lists would need too much memory.
        """
        scene = self._scene
        if int(capacity.count_needed(*scene, camera, cfg=self._cfg)) > MOST_ENTRIES:
            why = f"{camera.width} x {camera.height} pixels from here need too much memory."
            raise UserError(why, fix="move away from close objects, or choose a smaller width")
        with self._one_frame:
            return _frame(self._render_any(*scene, camera), camera)

    def stop(self) -> None:
        """Wait for the program that is being compiled, and compile no more.

        Without the wait, Python would abort at exit while JAX still works in another thread.
        """
        self._compiler.shutdown(cancel_futures=True)

    def _compile(self, size: Size, needed: int) -> Callable[..., Render]:
        """Return the program of a size, with room for the probes and `needed` tile-list entries."""
        self._on_change()
        scene, cameras = self._scene, [probe(size) for probe in self._probes]
        counts = [int(capacity.count_needed(*scene, c, cfg=self._cfg)) for c in cameras]
        entries = capacity.bucket(max(needed, *counts), capacity.ANYWHERE)
        static = {"cfg": self._cfg, "capacity": entries}
        run = capacity.compiled_renderer().lower(*scene, cameras[0], **static).compile()
        with self._one_frame:
            result = jax.block_until_ready(run(*scene, cameras[0]))
        self._warm_up(result)
        return run


def _succeeded(job: Future) -> bool:
    return job.done() and not job.cancelled() and job.exception() is None


def _frame(result: Render, camera: Camera) -> RenderedFrame:
    assert result.depth is not None
    alpha, depth = np.asarray(result.alpha), np.asarray(result.depth)
    return RenderedFrame(result.linear, alpha, depth, camera)


def full_size(canvas: Size, max_width: int) -> Size:
    """Return the size at rest: the size of the canvas, at most `max_width` pixels wide."""
    width, height = max(canvas[0], 1), max(canvas[1], 1)
    scale = min(1.0, max_width / width)
    return max(1, round(width * scale)), max(1, round(height * scale))


def render_sizes(full: Size) -> tuple[Size, ...]:
    """Return the sizes of renders for a canvas, from the smallest to `full`."""
    octaves = round(math.log2(full[0] / full[1]) * SHAPES_PER_OCTAVE) / SHAPES_PER_OCTAVE
    areas = [width * width / 1.6 for width in WIDTHS]
    sides = [
        (math.sqrt(area * 2**octaves), math.sqrt(area / 2**octaves))
        for area in areas
        if area < FULL_FROM * _area(full)
    ]
    return (*((_aligned(width), _aligned(height)) for width, height in sides), full)


def compilation_order(sizes: tuple[Size, ...]) -> tuple[Size, ...]:
    """Return the sizes in the order of compilation: a small one, the full one, then the others."""
    first = sizes[min(1, len(sizes) - 1)]
    return tuple(dict.fromkeys((first, sizes[-1], *reversed(sizes[:-1]))))


def next_size(
    sizes: tuple[Size, ...], ready: Collection[Size], current: Size | None, ms: float
) -> Size | None:
    """Return the size for the next frame of a moving camera, or None if none is compiled.

    `sizes` belong to the canvas and increase; `ready` sizes may belong to other canvases. The
    last frame took `ms` milliseconds at the size `current`, which stays unless another is better.
    """
    usable = [size for size in sizes if size in ready]
    if not usable:
        return min(ready, key=lambda size: abs(_area(size) - _area(sizes[0])), default=None)
    if current not in usable:
        return usable[0]
    at, per_pixel = usable.index(current), ms / _area(current)
    if ms > SHRINK_BEYOND * TARGET_MS:
        fast = [size for size in usable[:at] if per_pixel * _area(size) <= TARGET_MS]
        return fast[-1] if fast else usable[0]
    larger = usable[min(at + 1, len(usable) - 1)]
    return larger if per_pixel * _area(larger) <= ENLARGE_WITHIN * TARGET_MS else current


def _area(size: Size) -> int:
    return size[0] * size[1]


def _aligned(pixels: float) -> int:
    return max(ALIGN, round(pixels / ALIGN) * ALIGN)
