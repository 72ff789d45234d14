"""Two cameras before a wall."""

import numpy as np
import pytest
from PIL import Image

from p2gs_jax.types import Scene, View


@pytest.fixture(scope="module")
def two_views(tmp_path_factory):
    root = tmp_path_factory.mktemp("seams")
    K = np.array([[40, 0, 32], [0, 40, 24], [0, 0, 1]], np.float32)
    views = []
    for k in range(2):
        path = root / f"{k}.png"
        Image.new("RGB", (64, 48)).save(path)
        viewmat = np.eye(4, dtype=np.float32)
        viewmat[0, 3] = 0.3 * k
        views.append(View(path.name, path, "0", viewmat, K, 64, 48))
    return Scene(root, "made", tuple(views), np.zeros((1, 3), np.float32), None)
