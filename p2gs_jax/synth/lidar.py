"""A roof-mounted spinning LiDAR: first hits of its rays (paper, appendix "LiDAR").

64 channels from -25 to 15 degrees, 1.3 million points a second at 10 turns a second, 100 m, no
noise; a scan is taken at one instant, as the cameras are. Axes: x forward, y left, z up.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Float32

from p2gs_jax.synth.intersect import nearest_hit
from p2gs_jax.synth.town import Town

# Rays are traced sector by sector, against the primitives that the sector can meet.
_SECTORS = 48


@dataclass(frozen=True)
class Lidar:
    """The paper's LiDAR."""

    channels: int = 64
    lowest_degrees: float = -25.0
    highest_degrees: float = 15.0
    points_per_second: float = 1.3e6
    turns_per_second: float = 10.0
    range_m: float = 100.0
    mount: tuple[float, float, float] = (0.0, 0.0, 1.73)
    """On the vehicle, m."""

    @property
    def azimuths(self) -> int:
        """Directions in a turn, rounded to whole sectors."""
        each = self.points_per_second / self.turns_per_second / self.channels
        return max(1, round(each / _SECTORS)) * _SECTORS


class Scanner:
    """Scans one town; compiled once."""

    def __init__(self, town: Town, lidar: Lidar | None = None):
        """Begin without a compiled program."""
        self.town, self.lidar = town, lidar or Lidar()
        self._scan = jax.jit(self._trace)

    def scan(self, vehicle: Float[np.ndarray, " 3"]) -> Float32[np.ndarray, "n 3"]:
        """Return first hits within range, in the LiDAR's own axes, m.

        Args:
            vehicle: origin of the vehicle, which heads along +x.
        """
        origin = np.asarray(vehicle, np.float32) + np.asarray(self.lidar.mount, np.float32)
        directions, t = self._scan(jnp.asarray(origin))
        directions, t = np.asarray(directions), np.asarray(t)
        hit = t <= self.lidar.range_m
        return (directions[:, hit] * t[hit]).T.astype(np.float32)

    def _trace(self, origin: Array) -> tuple[Array, Array]:
        lidar, town = self.lidar, self.town
        elevation = np.deg2rad(
            np.linspace(lidar.lowest_degrees, lidar.highest_degrees, lidar.channels)
        )
        azimuth = 2 * np.pi * (np.arange(lidar.azimuths) + 0.5) / lidar.azimuths
        azimuth = azimuth.reshape(_SECTORS, -1)
        a, e = np.broadcast_arrays(azimuth[:, :, None], elevation)
        rays = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], 1)
        rays = rays.reshape(_SECTORS, 3, -1).astype(np.float32)
        middle = azimuth.mean(1)
        heading = np.stack([np.cos(middle), np.sin(middle)], 1).astype(np.float32)
        center = (town.lo + town.hi)[:, :2] / 2
        radius = np.linalg.norm((town.hi - town.lo)[:, :2], axis=1) / 2
        away = jnp.asarray(center) - origin[:2]
        distance = jnp.linalg.norm(away, axis=1)
        outside = jnp.maximum(distance, 1e-3)
        half = np.pi / _SECTORS + jnp.arcsin(jnp.minimum(radius / outside, 1.0))
        near = distance - radius < lidar.range_m

        def sector(item: tuple[Array, Array]) -> Array:
            directions, heading = item
            cosine = away @ heading / outside
            inside = (cosine >= jnp.cos(jnp.minimum(half, np.pi))) | (distance <= radius)
            return nearest_hit(town, origin[:, None], directions, near & inside)[0]

        t = lax.map(sector, (jnp.asarray(rays), jnp.asarray(heading)))
        return jnp.asarray(rays).transpose(1, 0, 2).reshape(3, -1), t.reshape(-1)
