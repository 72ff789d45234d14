"""Counts what XLA compiles: JAX offers listeners but no counter."""

from jax import monitoring

_COMPILED = "/jax/core/compile/backend_compile_duration"


class CompileCounter:
    """What XLA compiled since this counter was made, in all threads of the process."""

    def __init__(self):
        self._begin = len(_compiled)

    @property
    def programs(self) -> int:
        """Programs compiled, or read back from the cache on disk."""
        return len(_compiled) - self._begin

    @property
    def seconds(self) -> float:
        """Seconds that threads spent in the compiler or reading the cache, summed over threads."""
        return sum(_compiled[self._begin :], 0.0)


# Seconds of every program since this module was loaded.
_compiled: list[float] = []


def _on_duration(event: str, duration_secs: float, **_) -> None:
    if event == _COMPILED:
        _compiled.append(duration_secs)


monitoring.register_event_duration_secs_listener(_on_duration)
