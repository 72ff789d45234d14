"""What cameras do besides exposing: sums of few features, linear in log radiance.

A white balance per camera is a constant per channel; vignetting is a polynomial of the radius. Both
act on light, before the tone curve: like a point's log radiance they are multiplied by a = 2.2 /
gamma.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from p2gs_jax.config import VignettingKind
from p2gs_jax.photometry.adjustment.matrices import Terms
from p2gs_jax.photometry.adjustment.rows import Rows
from p2gs_jax.photometry.models import VIGNETTING_POWERS, polynomials

# Two directions that change the ratios of red, green and blue, and not their mean.
CHROMA = np.array([[2.0, -1.0, -1.0], [0.0, 1.0, -1.0]]) / np.sqrt([[6.0], [2.0]])


@dataclass(frozen=True)
class Features:
    """Which features there are; parameters are ordered as these fields are, camera by camera.

    Attributes:
        cameras: number of physical cameras.
        balance: a white balance per camera.
        vignetting: per camera, or per camera and channel.
    """

    cameras: int
    balance: bool = False
    vignetting: VignettingKind | None = None

    @property
    def vignetting_rows(self) -> int:
        """Polynomials of a camera."""
        return polynomials(self.vignetting)

    @property
    def balance_count(self) -> int:
        """Parameters of white balance."""
        return len(CHROMA) * self.cameras * self.balance

    @property
    def count(self) -> int:
        """Number of parameters."""
        return self.balance_count + self.cameras * self.vignetting_rows * len(VIGNETTING_POWERS)

    def terms(self, rows: Rows) -> Terms:
        """Return the features of every value."""
        camera = rows.cameras[rows.views][:, None]
        shape = (len(camera), 3)
        index, factor = [], []
        if self.balance:
            for direction, of_channel in enumerate(CHROMA):
                index.append(np.broadcast_to(camera + direction * self.cameras, shape))
                factor.append(np.broadcast_to(of_channel, shape))
        if self.vignetting:
            of_channel = np.arange(3) if self.vignetting == "channel" else np.zeros(3, int)
            polynomial = camera * self.vignetting_rows + of_channel
            for k, power in enumerate(VIGNETTING_POWERS):
                index.append(self.balance_count + polynomial * len(VIGNETTING_POWERS) + k)
                factor.append(np.broadcast_to(rows.radius2[:, None] ** (power // 2), shape))
        return Terms(np.stack(index, -1), np.stack(factor, -1), self.count)

    def balance_of(self, k: Float[np.ndarray, " k"]) -> Float[np.ndarray, "c 3"]:
        """Return the log factors of each camera on the channels."""
        if not self.balance:
            return np.zeros((self.cameras, 3))
        return k[: self.balance_count].reshape(len(CHROMA), self.cameras).T @ CHROMA

    def vignetting_of(self, k: Float[np.ndarray, " k"]) -> Float[np.ndarray, "c j p"]:
        """Return the coefficients of each camera's polynomials."""
        shape = (self.cameras, self.vignetting_rows, len(VIGNETTING_POWERS))
        return k[self.balance_count :].reshape(shape)
