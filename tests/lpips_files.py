"""Weights of LPIPS made at random, named as the state dict of the authors' PyTorch module."""

import numpy as np

from p2gs_jax.evaluation.lpips import PACKAGED


def made_arrays(net, seed=0):
    """Return random weights that keep the size of the features; those of channels are positive."""
    rng = np.random.default_rng(seed)
    arrays = {
        "scaling_layer.shift": np.float32([-0.030, -0.088, -0.188]).reshape(1, 3, 1, 1),
        "scaling_layer.scale": np.float32([0.458, 0.448, 0.450]).reshape(1, 3, 1, 1),
    }
    for name, shape in PACKAGED[net][0].shapes.items():
        if name.startswith("lin"):
            made = rng.uniform(0, 1, shape)
        else:
            made = rng.normal(0, 0.1 if len(shape) == 1 else np.sqrt(2 / np.prod(shape[1:])), shape)
        arrays[name] = made.astype(np.float32)
    return arrays


def write_weights(path, arrays):
    np.savez(path, **arrays)
    return path
