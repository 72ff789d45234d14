"""The devices of a fit, as a mesh of (views, Gaussians)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import jax
import numpy as np
from jax.sharding import Mesh

from p2gs_jax.errors import UserError

VIEWS, GAUSSIANS = AXES = ("views", "gaussians")


@dataclass(frozen=True)
class Devices:
    """Which devices a fit takes, and what is divided among them.

    Attributes:
        count: how many, or all that JAX sees.
        shard: `views`: every device holds all Gaussians; `gaussians`: each holds a part of them;
            `VxG`: V groups of G devices, among which a group's Gaussians are divided.
    """

    count: int | Literal["all"] = 1
    shard: str = "views"

    def total(self) -> int:
        """Return the number of devices.

        Raises:
            UserError: there are not so many.
        """
        there = jax.device_count()
        if self.count == "all":
            return there
        if self.count < 1:
            raise UserError(
                f"--devices {self.count} is no number of devices.", fix="give 1 or more, or all"
            )
        if self.count > there:
            raise UserError(
                f"--devices {self.count} asks for more than the {there} that JAX sees here "
                f"({jax.default_backend()}).",
                fix="give fewer, or all; on a CPU, XLA_FLAGS="
                f"--xla_force_host_platform_device_count={self.count} makes as many of its cores",
            )
        if jax.process_count() > 1 and self.count < there:
            raise UserError(
                f"--devices {self.count} would leave out {there - self.count} of the devices that "
                "the processes bring.",
                fix="start fewer processes, or leave out --devices",
            )
        return self.count

    def shape(self) -> tuple[int, int]:
        """Return how many devices there are along (views, Gaussians).

        Raises:
            UserError: there are not so many, or `shard` divides them otherwise.
        """
        total = self.total()
        if self.shard == "views":
            return total, 1
        if self.shard == "gaussians":
            return 1, total
        parts = self.shard.split("x")
        if len(parts) != 2 or not all(p.isdecimal() and int(p) for p in parts):
            raise UserError(
                f"--shard {self.shard} is none that exists.",
                fix="give views, gaussians, or VxG, such as 2x2 for two groups of two devices",
            )
        views, gaussians = map(int, parts)
        if views * gaussians != total:
            raise UserError(
                f"--shard {self.shard} takes {views * gaussians} devices, --devices gives {total}.",
                fix="give two numbers whose product is that of the devices",
            )
        return views, gaussians

    def mesh(self) -> Mesh:
        """Return the mesh.

        Raises:
            UserError: see `shape`.
        """
        shape = self.shape()
        chosen = np.array(jax.devices()[: shape[0] * shape[1]])
        return Mesh(chosen.reshape(shape), AXES)
