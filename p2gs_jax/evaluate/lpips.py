"""LPIPS, a learned perceptual distance (Zhang et al., CVPR 2018), version 0.1, in pure JAX.

Both images pass through the convolutions of AlexNet or VGG-16; after each of five blocks their
features, of unit length over channels, are compared with a learned weight per channel. Weights
are read by `lpips_weights`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from p2gs_jax.errors import UserError
from p2gs_jax.scene.pixels.store import size_at
from p2gs_jax.types import View

# Added to the length of a feature vector (the authors' code); a vector of zeros stays zero.
EPSILON = 1e-10


@dataclass(frozen=True)
class Convolution:
    """A convolution and the ReLU after it.

    Attributes:
        name: of its arrays in the weights file, without `.weight` and `.bias`.
        inputs: channels.
        outputs: channels.
        kernel: pixels along each side.
        stride: pixels.
        padding: zeros on each side.
    """

    name: str
    inputs: int
    outputs: int
    kernel: int = 3
    stride: int = 1
    padding: int = 1


@dataclass(frozen=True)
class Pool:
    """A maximum over squares of `kernel` pixels, `stride` pixels apart, without padding."""

    kernel: int
    stride: int = 2
    padding: int = 0


@dataclass(frozen=True)
class Network:
    """A network without what follows its last convolution.

    Attributes:
        name: as people write it.
        blocks: features are compared after each of them.
        seconds_per_pixel: of one comparison on two CPU cores (measured), for time budgets.
    """

    name: str
    blocks: tuple[tuple[Convolution | Pool, ...], ...]
    seconds_per_pixel: float

    @property
    def convolutions(self) -> tuple[Convolution, ...]:
        """All convolutions, in order."""
        return tuple(la for block in self.blocks for la in block if isinstance(la, Convolution))

    @property
    def channels(self) -> tuple[int, ...]:
        """Channels of the features after each block."""
        return tuple(
            [la.outputs for la in block if isinstance(la, Convolution)][-1] for block in self.blocks
        )

    @property
    def smallest(self) -> int:
        """Width and height below which nothing is left after the last block."""
        size = 1
        for block in reversed(self.blocks):
            for layer in reversed(block):
                size = (size - 1) * layer.stride + layer.kernel - 2 * layer.padding
        return size


def lin_name(block: int) -> str:
    """Return what the weights file calls the weights of channels after a block."""
    return f"lin{block}.model.1.weight"


# Layers and their places as in torchvision, by which the weights are named.
ALEXNET = Network(
    "AlexNet",
    (
        (Convolution("net.slice1.0", 3, 64, kernel=11, stride=4, padding=2),),
        (Pool(3), Convolution("net.slice2.3", 64, 192, kernel=5, padding=2)),
        (Pool(3), Convolution("net.slice3.6", 192, 384)),
        (Convolution("net.slice4.8", 384, 256),),
        (Convolution("net.slice5.10", 256, 256),),
    ),
    seconds_per_pixel=1.1e-6,
)
VGG16 = Network(
    "VGG-16",
    (
        (Convolution("net.slice1.0", 3, 64), Convolution("net.slice1.2", 64, 64)),
        (Pool(2), Convolution("net.slice2.5", 64, 128), Convolution("net.slice2.7", 128, 128)),
        (
            Pool(2),
            Convolution("net.slice3.10", 128, 256),
            Convolution("net.slice3.12", 256, 256),
            Convolution("net.slice3.14", 256, 256),
        ),
        (
            Pool(2),
            Convolution("net.slice4.17", 256, 512),
            Convolution("net.slice4.19", 512, 512),
            Convolution("net.slice4.21", 512, 512),
        ),
        (
            Pool(2),
            Convolution("net.slice5.24", 512, 512),
            Convolution("net.slice5.26", 512, 512),
            Convolution("net.slice5.28", 512, 512),
        ),
    ),
    seconds_per_pixel=2.4e-5,
)


class LpipsWeights(eqx.Module):
    """A network with its weights.

    Attributes:
        network: which one.
        kernels: of each convolution, by its name.
        biases: of each convolution, by its name.
        lins: weight of each channel in the comparison after each block.
        shift: subtracted from the colours, which then reach from -1 to 1.
        scale: what they are divided by after that.
    """

    network: Network = eqx.field(static=True)
    kernels: dict[str, Float[Array, "kh kw i o"]]
    biases: dict[str, Float[Array, " o"]]
    lins: tuple[Float[Array, " c"], ...]
    shift: Float[Array, " 3"]
    scale: Float[Array, " 3"]

    def require_size(self, width: int, height: int, name: str = "the image") -> None:
        """Refuse an image of which the network leaves nothing.

        Args:
            width: pixels.
            height: pixels.
            name: of the image.

        Raises:
            UserError: it is too small.
        """
        least = self.network.smallest
        if min(width, height) < least:
            raise UserError(
                f"{name} is {width}x{height} pixels: too small for LPIPS on {self.network.name}, "
                f"which needs at least {least}x{least}.",
                fix="use larger images (--max-width), or leave out --lpips-weights",
            )

    def require_sizes(self, views: Sequence[View], max_width: int | None) -> None:
        """Refuse views that are too small, before anything is computed.

        Args:
            views: whose photographs will be compared.
            max_width: see `size_at`.

        Raises:
            UserError: see `require_size`.
        """
        for view in views:
            self.require_size(*size_at(view, max_width), view.name)


def lpips(
    weights: LpipsWeights,
    ldr: Float[Array, "h w 3"],
    target: Float[Array, "h w 3"],
    mask: Float[Array, "h w"],
) -> Float[Array, ""]:
    """Return the distance of two images; 0 where they agree.

    Args:
        weights: the network.
        ldr: a rendered image, display values in [0, 1].
        target: the photograph, display values in [0, 1].
        mask: 1 = use; elsewhere the photograph takes the rendered image's place. The mean over the
            image keeps those pixels, so that a masked area lowers the distance.

    Raises:
        UserError: the images are too small for the network.
    """
    height, width = mask.shape
    weights.require_size(width, height)
    return _distance(weights, ldr, target, mask)


@jax.jit
def _distance(weights: LpipsWeights, ldr, target, mask) -> Float[Array, ""]:
    pair = jnp.stack([jnp.where(mask[..., None] > 0, ldr, target), target])
    features = (2 * pair - 1 - weights.shift) / weights.scale
    total = jnp.float32(0)
    for block, lin in zip(weights.network.blocks, weights.lins, strict=True):
        for layer in block:
            features = _apply(weights, layer, features)
        a, b = features / (jnp.linalg.norm(features, axis=-1, keepdims=True) + EPSILON)
        total += jnp.mean((a - b) ** 2 @ lin)
    return total


def _apply(
    weights: LpipsWeights, layer: Convolution | Pool, x: Float[Array, "n h w c"]
) -> Float[Array, "n h2 w2 c2"]:
    strides = (layer.stride, layer.stride)
    if isinstance(layer, Pool):
        window = (1, layer.kernel, layer.kernel, 1)
        return lax.reduce_window(x, -jnp.inf, lax.max, window, (1, *strides, 1), "VALID")
    out = lax.conv_general_dilated(
        x,
        weights.kernels[layer.name],
        strides,
        [(layer.padding, layer.padding)] * 2,
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
        # Accelerators would round the factors; the numbers should not depend on the device.
        precision=lax.Precision.HIGHEST,
    )
    return jnp.maximum(out + weights.biases[layer.name], 0)
