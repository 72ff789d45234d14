"""`doctor` and `completion`: checks of the machine, and set-up of the shell."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import tyro

Shell = Literal["bash", "zsh", "fish"]


@dataclass(frozen=True)
class Doctor:
    """Say what works here, and what to install for what does not.

    Versions, devices, cores, memory, disk, the cache of compiled programs, which rasterizer a fit
    would use, and a self-test: three Gaussians rendered, with gradients. Exit code 1 where
    something that everything needs is broken.

        p2gs-jax doctor
        p2gs-jax doctor --json > doctor.json
    """

    json: bool = False
    """Print JSON, to attach to a report of a problem."""
    skip_self_test: bool = False
    """Render nothing: the self-test waits for the compiler, up to half a minute."""


@dataclass(frozen=True)
class Completion:
    """Print what your shell needs to complete commands and options.

    p2gs-jax completion bash > ~/.local/share/bash-completion/completions/p2gs-jax
    p2gs-jax completion zsh > "${fpath[1]}/_p2gs-jax"
    p2gs-jax completion fish > ~/.config/fish/completions/p2gs-jax.fish
    """

    shell: Annotated[Shell, tyro.conf.Positional]
    """bash, zsh or fish."""
