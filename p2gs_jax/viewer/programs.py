"""The renderer, compiled for a few sizes in the background, so that frames never wait.

`render/host.py` waits for the compiler; here a frame whose tile lists overflow is rendered at a
smaller size while a program with longer lists is compiled.
"""

from __future__ import annotations

import sys
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import jax
from jaxtyping import Array, Bool

from p2gs_jax.config import RenderConfig
from p2gs_jax.errors import UserError
from p2gs_jax.render.capacity import ANYWHERE, TileCapacity, compiled_renderer, count_needed
from p2gs_jax.types import Camera, Gaussians, Render
from p2gs_jax.viewer.render_sizes import Size

# Most entries of a tile list; a camera inside a splat may need any number.
MOST_ENTRIES = 2**26
PROBES = 4


@dataclass(frozen=True)
class _Program:
    capacity: TileCapacity
    run: Callable[[Gaussians, Bool[Array, " n"], Camera], Render]


class Programs:
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
        """Begin without a program.

        Args:
            gaussians: the scene.
            alive: slots in use.
            cfg: rendering options.
            probes: functions from a size to a typical camera; new programs are run on them.
            on_change: called when a program was compiled, or is about to be.
            warm_up: called with a render of every new size, to compile what uses it.
        """
        self._scene = (gaussians, alive)
        self._cfg = cfg
        self._probes = probes[:PROBES]
        self._on_change, self._warm_up = on_change, warm_up
        self._programs: dict[Size, _Program] = {}
        self._most: dict[Size, int] = {}
        self._took_ms: dict[Size, float] = {}
        self._wanted: list[Size] = []
        self._now: Size | None = None
        self._compiled = 0
        self._changed = threading.Condition()
        self._one_frame = threading.Lock()
        self._stopping = False
        self.failure: str | None = None
        """What went wrong last, or None."""
        self._worker = threading.Thread(target=self._work, name="compile", daemon=True)
        self._worker.start()

    @property
    def ready(self) -> frozenset[Size]:
        """Sizes that render at once."""
        with self._changed:
            return frozenset(self._programs)

    @property
    def compiled(self) -> int:
        """How many programs have been compiled so far."""
        with self._changed:
            return self._compiled

    @property
    def compiling(self) -> Size | None:
        """What is being compiled, or None."""
        with self._changed:
            return self._now

    @property
    def took_ms(self) -> dict[Size, float]:
        """How long the last probes of every size took."""
        with self._changed:
            return dict(self._took_ms)

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
            result = program.run(*self._scene, camera)
            needed = int(result.count)
        with self._changed:
            self._most[size] = max(self._most.get(size, 0), needed)
            if not bool(result.overflow):
                return result
            if needed <= MOST_ENTRIES and self._programs.get(size) is program:
                del self._programs[size]
                self._wanted = [size, *(s for s in self._wanted if s != size)]
                self._changed.notify_all()
        return None

    def render_now(self, camera: Camera) -> Render:
        """Return a view of any size; compile a program and enlarge its tile lists as needed.

        Raises:
            UserError: it would need more memory than is reasonable.
        """
        size = (camera.width, camera.height)
        while True:
            result = self.render(camera)
            if result is not None:
                return result
            if self._most.get(size, 0) > MOST_ENTRIES:
                raise UserError(
                    f"{size[0]} x {size[1]} pixels from here need too much memory.",
                    fix="move away from what is close, or choose a smaller width",
                )
            self._compile(size)

    def stop(self) -> None:
        """Stop compiling, and wait for the program that is being compiled.

        An interpreter that ends while JAX works in another thread aborts.
        """
        with self._changed:
            self._stopping = True
            self._wanted.clear()
            self._changed.notify_all()
        self._worker.join()

    def _work(self) -> None:
        while True:
            with self._changed:
                while not self._wanted and not self._stopping:
                    self._changed.wait()
                if self._stopping:
                    return
                size = self._now = self._wanted.pop(0)
            self._on_change()
            try:
                self._compile(size)
            except Exception as error:  # such as too little memory: other sizes may still do
                traceback.print_exc(file=sys.stderr)
                self.failure = f"{size[0]} x {size[1]} cannot be compiled: {error}"
            with self._changed:
                self._now = None
            self._on_change()

    def _compile(self, size: Size) -> None:
        """Compile a size, with tile lists as long as it is known to need, and run it once."""
        with self._changed:
            first = not self._most
        if first:
            self._count(size)
        while True:
            with self._changed:
                if self._stopping:
                    return
                capacity = TileCapacity.allocate(self._expected(size), ANYWHERE)
                old = self._programs.get(size)
            if old is not None and old.capacity.holds(capacity.entries):
                return
            static = {"cfg": self._cfg, "capacity": capacity.entries}
            camera = self._probes[0](size)
            run = compiled_renderer().lower(*self._scene, camera, **static).compile()
            most, fastest = self._run_probes(run, size)
            with self._changed:
                self._most[size] = max(self._most.get(size, 0), most)
                if capacity.holds(most):
                    self._programs[size] = _Program(capacity, run)
                    self._took_ms[size] = fastest
                    self._compiled += 1
                    return

    def _count(self, size: Size) -> None:
        """Count the entries that typical views need: cheaper than compiling twice."""
        needed = [count_needed(*self._scene, probe(size), cfg=self._cfg) for probe in self._probes]
        most = max(map(int, needed))
        with self._changed:
            self._most[size] = most

    def _expected(self, size: Size) -> int:
        """Return the expected entries of a size; at most in proportion to the area."""
        if size in self._most:
            return self._most[size]
        area = size[0] * size[1]
        near = min(self._most, key=lambda other: abs(other[0] * other[1] - area))
        return int(self._most[near] * max(1.0, area / (near[0] * near[1])))

    def _run_probes(self, run, size: Size) -> tuple[int, float]:
        """Return the entries that typical views need, and the time of the fastest one."""
        most, fastest = 0, float("inf")
        for camera in [probe(size) for probe in self._probes]:
            with self._one_frame:
                begin = time.perf_counter()
                result = run(*self._scene, camera)
                jax.block_until_ready(result)
                fastest = min(fastest, 1e3 * (time.perf_counter() - begin))
            most = max(most, int(result.count))
            self._warm_up(result)
        return most, fastest
