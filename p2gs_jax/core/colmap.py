"""pycolmap under Python's handlers of signals: its import replaces the handler of SIGTERM."""

from p2gs_jax.core import interrupts

with interrupts.kept():
    import pycolmap

__all__ = ["pycolmap"]
