"""What may differ between views: the table of photometric models, from the simplest on."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Int

from p2gs_jax.config import PhotometricModel as ModelName
from p2gs_jax.photometry.response import Response

Level = Literal["camera", "view"]


class Model(NamedTuple):
    """What varies.

    Attributes:
        exposure: per what the exposure varies; None if it does not.
        gamma: likewise.
        description: what reports call it.
    """

    exposure: Level | None
    gamma: Level | None
    description: str


MODELS: dict[ModelName, Model] = {
    "constant": Model(None, None, "one exposure for all views"),
    "camera_exposure": Model("camera", None, "an exposure per camera"),
    "camera_exposure_gamma": Model("camera", "camera", "an exposure and a gamma per camera"),
    "view_exposure": Model("view", None, "an exposure per view"),
    "view_exposure_camera_gamma": Model(
        "view", "camera", "an exposure per view and a gamma per camera"
    ),
    "view_exposure_gamma": Model("view", "view", "an exposure and a gamma per view"),
}


def distinct_models(cameras: Int[np.ndarray, " v"]) -> list[ModelName]:
    """Return the models that differ: with one camera, "per camera" means "for all".

    Args:
        cameras: physical camera of each view, 0, 1, ...
    """
    several = cameras.max(initial=0) > 0
    return [name for name, m in MODELS.items() if several or "camera" not in (m.exposure, m.gamma)]


def parameter_count(model: ModelName, response: Response, cameras: int, views: int) -> int:
    """Return the number of free parameters; each level loses one to its gauge.

    Args:
        model: what varies.
        response: adds those of its spline.
        cameras: number of physical cameras.
        views: number of views.
    """
    size = {None: 0, "camera": cameras - 1, "view": views - 1}
    varies = MODELS[model]
    return size[varies.exposure] + size[varies.gamma] + response.extra_parameters
