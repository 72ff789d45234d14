"""What a fit of a part of a scene is given, because it was solved for the whole."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from p2gs_jax.gaussians.shell import Sphere
from p2gs_jax.run.decisions import Decisions
from p2gs_jax.types import Photometry


@dataclass(frozen=True)
class Part:
    """The photometry of a part, in the gauge of the whole, which the fit does not move.

    Attributes:
        photometry: of the part's training views.
        decisions: of the whole, with exposures that stay.
        radiance: of the part's points, linear.
        shell: where the whole puts what lies behind everything.
    """

    photometry: Photometry
    decisions: Decisions
    radiance: Float32[np.ndarray, "p 3"]
    shell: Sphere
