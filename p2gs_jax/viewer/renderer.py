"""The renderer, compiled for a few sizes in the background, so that frames never wait.

Every size needs its own compiled program, so there are few: six widths in a few aspect ratios.
Pixels need not be square: until the size of a canvas is compiled, another one is stretched over it.
A frame whose tile lists overflow is rendered at a smaller size while a program with longer lists is
compiled.
"""

from __future__ import annotations

import math
import sys
import threading
import traceback
from collections.abc import Callable, Collection, Sequence

import jax
from jaxtyping import Array, Bool

from p2gs_jax.config import RenderConfig
from p2gs_jax.errors import UserError
from p2gs_jax.render.capacity import (
    ANYWHERE,
    TileCapacity,
    compiled_renderer,
    count_needed,
    make_renderer,
)
from p2gs_jax.types import Camera, Gaussians, Render
from p2gs_jax.viewer.camera import Size

# Most entries of a tile list; a camera inside a splat may need any number.
MOST_ENTRIES = 2**26
# Widths at an aspect of 16:10; areas grow by 2.25.
WIDTHS = (320, 480, 720, 1080, 1620, 2430)
# Aspect ratios per factor of two: pixels are at most 9 % out of square.
SHAPES_PER_OCTAVE = 4
ALIGN = 8
# Sizes with more than this share of the full size's pixels would save too little.
FULL_FROM = 0.6
# Target time of a frame while the camera moves, milliseconds.
TARGET_MS = 75.0
# Move to the next larger size if it is expected within the first share of the target time, and to
# a smaller one beyond the second.
ENLARGE_WITHIN, SHRINK_BEYOND = 0.85, 1.25


class Renderer:
    """Renders views of compiled sizes, and compiles others in a thread.

    All methods may be called from any thread; one frame is rendered at a time.

    Attributes:
        compiling: what is being compiled, or None.
        failure: what went wrong last, or None.
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
        """Begin without a program.

        Args:
            gaussians: the scene.
            alive: slots in use.
            cfg: rendering options.
            probes: functions from a size to a typical camera; new programs are run on them.
            on_change: called when a program was compiled, or is about to be.
            warm_up: called with a render of every new size, to compile what uses it.
        """
        self.compiling: Size | None = None
        self.failure: str | None = None
        self._scene, self._cfg, self._probes = (gaussians, alive), cfg, probes
        self._on_change, self._warm_up = on_change, warm_up
        self._render_any = make_renderer(cfg)
        self._programs: dict[Size, Callable[..., Render]] = {}
        # The most entries of a tile list that views needed.
        self._most: dict[Size, int] = {}
        self._wanted: list[Size] = []
        self._stopping = False
        self._changed = threading.Condition()
        self._one_frame = threading.Lock()
        self._worker = threading.Thread(target=self._work, name="compile", daemon=True)
        self._worker.start()

    @property
    def ready(self) -> frozenset[Size]:
        """Sizes that render at once."""
        with self._changed:
            return frozenset(self._programs)

    def request(self, sizes: Sequence[Size]) -> None:
        """Compile these sizes next, in this order, and then those requested before."""
        with self._changed:
            new = [s for s in sizes if s not in self._programs]
            self._wanted = list(dict.fromkeys((*new, *self._wanted)))
            self._changed.notify_all()

    def render(self, camera: Camera) -> Render | None:
        """Return a view, or None where its size is not compiled or its tile lists overflow.

        After an overflow the size is not ready until a program with longer lists is compiled.
        """
        size = (camera.width, camera.height)
        with self._changed:
            program = self._programs.get(size)
        if program is None:
            return None
        with self._one_frame:
            result = program(*self._scene, camera)
            needed = int(result.count)
        if not bool(result.overflow):
            return result
        with self._changed:
            self._most[size] = max(self._most[size], needed)
            if needed <= MOST_ENTRIES and self._programs.get(size) is program:
                del self._programs[size]
                self._wanted = [size, *(s for s in self._wanted if s != size)]
                self._changed.notify_all()
        return None

    def render_now(self, camera: Camera) -> Render:
        """Return a view of any size, however long its program takes to compile.

        Raises:
            UserError: it would need more memory than is reasonable.
        """
        if int(count_needed(*self._scene, camera, cfg=self._cfg)) > MOST_ENTRIES:
            raise UserError(
                f"{camera.width} x {camera.height} pixels from here need too much memory.",
                fix="move away from what is close, or choose a smaller width",
            )
        with self._one_frame:
            return self._render_any(*self._scene, camera)

    def stop(self) -> None:
        """Stop compiling, and wait for the program that is being compiled.

        An interpreter that ends while JAX works in another thread aborts.
        """
        with self._changed:
            self._stopping = True
            self._changed.notify_all()
        self._worker.join()

    def _work(self) -> None:
        while True:
            with self._changed:
                while not self._wanted and not self._stopping:
                    self._changed.wait()
                if self._stopping:
                    return
                size = self.compiling = self._wanted.pop(0)
            self._on_change()
            try:
                self._compile(size)
            except Exception as error:  # such as too little memory: other sizes may still do
                traceback.print_exc(file=sys.stderr)
                self.failure = f"{size[0]} x {size[1]} cannot be compiled: {error}"
            self.compiling = None
            self._on_change()

    def _compile(self, size: Size) -> None:
        """Compile a size, with tile lists as long as it is known to need, and run its probes."""
        cameras = [probe(size) for probe in self._probes]
        most, fits = self._expected(size, cameras), False
        while not fits and not self._stopping:
            capacity = TileCapacity.allocate(most, ANYWHERE)
            static = {"cfg": self._cfg, "capacity": capacity.entries}
            run = compiled_renderer().lower(*self._scene, cameras[0], **static).compile()
            for camera in cameras:
                with self._one_frame:
                    result = jax.block_until_ready(run(*self._scene, camera))
                most = max(most, int(result.count))
                self._warm_up(result)
            fits = capacity.holds(most)
            with self._changed:
                self._most[size] = max(self._most.get(size, 0), most)
                if fits:
                    self._programs[size] = run

    def _expected(self, size: Size, cameras: Sequence[Camera]) -> int:
        """Return the entries that a size needs: as seen, in proportion to the area, or counted."""
        with self._changed:
            most, area = dict(self._most), _area(size)
        if size in most:
            return most[size]
        if most:
            near = min(most, key=lambda other: abs(_area(other) - area))
            return int(most[near] * max(1.0, area / _area(near)))
        # Cheaper than compiling twice.
        return max(int(count_needed(*self._scene, c, cfg=self._cfg)) for c in cameras)


def full_size(canvas: Size, max_width: int) -> Size:
    """Return what to render at rest: the canvas itself, pixel for pixel, up to a width."""
    width, height = max(canvas[0], 1), max(canvas[1], 1)
    scale = min(1.0, max_width / width)
    return max(1, round(width * scale)), max(1, round(height * scale))


def render_sizes(full: Size) -> tuple[Size, ...]:
    """Return the sizes to render a canvas at, smallest first and `full` last."""
    octaves = round(math.log2(full[0] / full[1]) * SHAPES_PER_OCTAVE) / SHAPES_PER_OCTAVE
    areas = [width * width / 1.6 for width in WIDTHS]
    sides = [
        (math.sqrt(area * 2**octaves), math.sqrt(area / 2**octaves))
        for area in areas
        if area < FULL_FROM * _area(full)
    ]
    return (*((_aligned(width), _aligned(height)) for width, height in sides), full)


def compilation_order(sizes: tuple[Size, ...]) -> tuple[Size, ...]:
    """Return the sizes in the order to compile them: a small one, the full size, then the rest."""
    first = sizes[min(1, len(sizes) - 1)]
    return tuple(dict.fromkeys((first, sizes[-1], *reversed(sizes[:-1]))))


def next_size(
    sizes: tuple[Size, ...], ready: Collection[Size], current: Size | None, ms: float
) -> Size | None:
    """Return the size for the next frame of a moving camera, or None where none is ready.

    Args:
        sizes: of the canvas, smallest first.
        ready: sizes that are compiled, of this canvas or another.
        current: size of the last frame, kept unless another is clearly better; None: there is none.
        ms: how long that frame took.
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
