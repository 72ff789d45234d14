"""Entry point of `python -m p2gs_jax.cli`."""

from p2gs_jax.cli import main

main()
