"""Decodes photographs that another process names: `python -m p2gs_jax.scene.pixels.worker`.

Reads pickled (view, sizes, paths) from its standard input, and answers each with a byte. It ends
with its input, so with who started it.
"""

from __future__ import annotations

import contextlib
import pickle
import sys
from typing import BinaryIO

from p2gs_jax.errors import UserError
from p2gs_jax.scene.pixels.decode import decode
from p2gs_jax.scene.pixels.files import write_photograph


def serve(jobs: BinaryIO, answers: BinaryIO) -> None:
    """Decode until there are no more jobs."""
    while True:
        try:
            view, sizes, paths = pickle.load(jobs)
        except EOFError:
            return
        # Who asks for it meets the same error, and says it.
        with contextlib.suppress(UserError, OSError):
            for path, photograph in zip(paths, decode(view, sizes), strict=True):
                write_photograph(path, photograph)
        answers.write(b".")
        answers.flush()


if __name__ == "__main__":
    serve(sys.stdin.buffer, sys.stdout.buffer)
