"""pycolmap under Python's handlers of signals: its import replaces the handler of SIGTERM."""

import pycolmap

from p2gs_jax.core import interrupts

__all__ = ["pycolmap"]

interrupts.install_again()
