"""Which devices a fit takes, and what it cannot do on several."""

from __future__ import annotations

import dataclasses

from jax.sharding import Mesh

from p2gs_jax.config import FitConfig
from p2gs_jax.core.devices import Devices
from p2gs_jax.errors import UserError


def with_a_view_each(cfg: FitConfig, devices: Devices) -> FitConfig:
    """Return a configuration that gives every device a view where it says nothing of batches.

    Raises:
        UserError: there are not so many devices.
    """
    count = devices.total()
    if count == 1 or cfg.train.batch > 1:
        return cfg
    return dataclasses.replace(cfg, train=dataclasses.replace(cfg.train, batch=count))


def mesh_of(cfg: FitConfig, devices: Devices | None) -> Mesh | None:
    """Return the mesh of a fit; None for one view a step on one device.

    Raises:
        UserError: there are not so many devices, the batch cannot be shared out among them, or
            what is asked for takes one view a step.
    """
    mesh = (devices or Devices()).mesh()
    batch = cfg.train.batch
    if batch < 1:
        raise UserError(f"--train.batch is {batch}.", fix="give 1 or more")
    if batch == 1 and mesh.size == 1:
        return None
    if batch % mesh.size:
        raise UserError(
            f"--train.batch {batch} cannot be shared out among {mesh.size} devices.",
            fix=f"give a multiple of {mesh.size}, such as --train.batch "
            f"{-(-batch // mesh.size) * mesh.size}",
        )
    if cfg.densify.max_gaussians == "auto":
        raise UserError(
            "--gaussians auto takes one view a step: it compares stages of single steps.",
            fix="give a number (--gaussians N) or leave the option out, or leave out --devices and "
            "--train.batch",
        )
    if cfg.dynamics.correct_poses:
        raise UserError(
            "--dynamics.correct-poses takes one view a step: corrections are of one moment.",
            fix="leave it out, or leave out --devices and --train.batch",
        )
    return mesh
