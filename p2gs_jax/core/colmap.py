"""The import of pycolmap, which replaces the handler of SIGTERM: Python's handlers stay."""

from p2gs_jax.core import interrupts

with interrupts.kept():
    import pycolmap

__all__ = ["pycolmap"]
