"""Weights of LPIPS made at random, named as the state dict of the authors' PyTorch module."""

import numpy as np

# Place in torchvision's `features`: (slice, channels out, in, kernel).
CONVOLUTIONS = {
    "alex": {
        0: (1, 64, 3, 11),
        3: (2, 192, 64, 5),
        6: (3, 384, 192, 3),
        8: (4, 256, 384, 3),
        10: (5, 256, 256, 3),
    },
    "vgg": {
        0: (1, 64, 3, 3),
        2: (1, 64, 64, 3),
        5: (2, 128, 64, 3),
        7: (2, 128, 128, 3),
        10: (3, 256, 128, 3),
        12: (3, 256, 256, 3),
        14: (3, 256, 256, 3),
        17: (4, 512, 256, 3),
        19: (4, 512, 512, 3),
        21: (4, 512, 512, 3),
        24: (5, 512, 512, 3),
        26: (5, 512, 512, 3),
        28: (5, 512, 512, 3),
    },
}
CHANNELS = {"alex": (64, 192, 384, 256, 256), "vgg": (64, 128, 256, 512, 512)}


def made_arrays(net, seed=0):
    """Return random weights that keep the size of the features; those of channels are positive."""
    rng = np.random.default_rng(seed)
    arrays = {
        "scaling_layer.shift": np.float32([-0.030, -0.088, -0.188]).reshape(1, 3, 1, 1),
        "scaling_layer.scale": np.float32([0.458, 0.448, 0.450]).reshape(1, 3, 1, 1),
    }
    for place, (part, out, into, kernel) in CONVOLUTIONS[net].items():
        name = f"net.slice{part}.{place}"
        deviation = np.sqrt(2 / (into * kernel**2))
        shape = (out, into, kernel, kernel)
        arrays[f"{name}.weight"] = rng.normal(0, deviation, shape).astype(np.float32)
        arrays[f"{name}.bias"] = rng.normal(0, 0.1, out).astype(np.float32)
    for k, channels in enumerate(CHANNELS[net]):
        weight = rng.uniform(0, 1, (1, channels, 1, 1)).astype(np.float32)
        arrays[f"lin{k}.model.1.weight"] = weight
    return arrays


def write_weights(path, arrays):
    np.savez(path, **arrays)
    return path
