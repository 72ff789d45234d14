"""Counts the programs that XLA compiles: JAX offers listeners but no counter."""

from jax import monitoring

_COMPILED = "/jax/core/compile/backend_compile_duration"
_compiled = [0]


class CompileCounter:
    """Counts programs since it was made, in all threads of the process."""

    def __init__(self):
        self._begin = _compiled[0]

    @property
    def programs(self) -> int:
        """The number of programs compiled, or read back from the cache on disk."""
        return _compiled[0] - self._begin


def _on_duration(event: str, duration_secs: float, **_) -> None:
    _compiled[0] += event == _COMPILED


monitoring.register_event_duration_secs_listener(_on_duration)
