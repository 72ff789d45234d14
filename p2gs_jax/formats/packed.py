"""Gaussians in few bytes: columns of small integers between the bounds of a chunk.

Neighbours in space follow each other (Morton order) and form chunks. Every column of a chunk is
stored as integers between its least and its largest value, with separate low and high bytes, and
deflated. Lengths and (under the activation `exp`) radiance are logarithms, and opacities logits, so
that errors are relative at any dynamic range. `p2gs_jax/export/web/decode.js` reads this format.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float32, Int

from p2gs_jax.core.numerics import on_device
from p2gs_jax.render.project import LOG_SCALE_RANGE
from p2gs_jax.types import Gaussians

CHUNK = 256
# Bits of centres, lengths, rotations (each coordinate), opacity, harmonics of degree 0, and other
# harmonics (our choice; an exported web page states the resulting error).
MEANS, SCALES, ROTATIONS, OPACITY, BASE, BANDS = 16, 10, 11, 10, 12, 8
# Columns before the harmonics: 3 each for centres, lengths and rotations, and 1 for opacity.
GEOMETRY = 10
# Beyond this limit of the logit, opacity is within 2e-7 of 0 or 1.
LOGIT_LIMIT = 16.0


@dataclass(frozen=True)
class Packed:
    """Bytes, the number of Gaussians, and the number of harmonic coefficients of each channel.

    The bytes are deflated (zlib): least and largest values as float32, by column and chunk; then
    the low bytes of each column, followed by its high bytes if it has more than 8 bits.
    """

    count: int
    coefficients: int
    data: bytes

    @property
    def header(self) -> dict[str, Any]:
        """The values that a reader of the bytes needs, as plain values."""
        sizes = {"count": self.count, "chunk": CHUNK, "coefficients": self.coefficients}
        return {**sizes, "bits": column_bits(self.coefficients)}


def column_bits(coefficients: int) -> list[int]:
    """Return the number of bits of every column."""
    geometry = [MEANS] * 3 + [SCALES] * 3 + [ROTATIONS] * 3 + [OPACITY]
    return geometry + [BASE] * 3 + [BANDS] * 3 * (coefficients - 1)


def morton_order(means: Float32[np.ndarray, "n 3"]) -> Int[np.ndarray, " n"]:
    """Return an order in which neighbours in space follow each other.

    Along each axis all cells hold equally many Gaussians, so that a far sky does not make the cells
    of the street coarse.
    """
    count = max(len(means), 1)
    code = np.zeros(len(means), np.int64)
    for axis in range(3):
        rank = np.argsort(np.argsort(means[:, axis], kind="stable"))
        cell = rank * 1024 // count  # 10 bits
        for bit in range(10):
            code |= (cell >> bit & 1) << (3 * bit + axis)
    return np.argsort(code, kind="stable")


def pack(gaussians: Gaussians) -> Packed:
    """Return finite Gaussians as bytes, in Morton order."""
    columns = _columns(gaussians)
    columns = columns[:, morton_order(np.asarray(gaussians.means))]
    count, coefficients = gaussians.capacity, gaussians.sh.shape[1]
    starts = np.arange(0, count, CHUNK)
    low, high = (f.reduceat(columns, starts, axis=1) for f in (np.minimum, np.maximum))
    parts = [np.stack([low, high], 1).astype("<f4").tobytes()]
    for row, bits in enumerate(column_bits(coefficients)):
        least, span = (np.repeat(v[row], CHUNK)[:count] for v in (low, high - low))
        share = (columns[row] - least) / np.where(span > 0, span, 1)
        whole = np.rint(share.astype(np.float64) * (2**bits - 1)).astype(np.uint16)
        parts.append((whole & 255).astype(np.uint8).tobytes())
        if bits > 8:
            parts.append((whole >> 8).astype(np.uint8).tobytes())
    return Packed(count, coefficients, zlib.compress(b"".join(parts), 9))


def unpack(packed: Packed) -> Gaussians:
    """Return the Gaussians as a reader of the bytes decodes them."""
    raw, count, bits = zlib.decompress(packed.data), packed.count, column_bits(packed.coefficients)
    chunks = -(-count // CHUNK)
    bounds = np.frombuffer(raw, "<f4", 2 * len(bits) * chunks).reshape(len(bits), 2, chunks)
    at, columns = bounds.nbytes, np.empty((len(bits), count), np.float32)
    for row, width in enumerate(bits):
        whole = np.frombuffer(raw, np.uint8, count, at).astype(np.float64)
        at += count
        if width > 8:
            whole += 256.0 * np.frombuffer(raw, np.uint8, count, at)
            at += count
        low, high = (np.repeat(bounds[row, k].astype(np.float64), CHUNK)[:count] for k in (0, 1))
        columns[row] = low + whole * (high - low) / (2**width - 1)
    xyz = columns[6:9].T
    w = np.sqrt(np.maximum(1 - (xyz.astype(np.float64) ** 2).sum(1), 0))
    sh = columns[GEOMETRY:].reshape(packed.coefficients, 3, count).transpose(2, 0, 1)
    return Gaussians(
        means=on_device(columns[:3].T),
        quats=on_device(np.concatenate([w[:, None], xyz], 1).astype(np.float32)),
        log_scales=on_device(columns[3:6].T),
        opacity_logits=on_device(columns[9]),
        sh=on_device(sh),
    )


def _columns(g: Gaussians) -> Float32[np.ndarray, "c n"]:
    sh = np.asarray(g.sh, np.float32)
    parts = (
        np.asarray(g.means, np.float32).T,
        np.clip(np.asarray(g.log_scales, np.float32), *LOG_SCALE_RANGE).T,
        _small_rotations(np.asarray(g.quats)).T,
        np.clip(np.asarray(g.opacity_logits, np.float32), -LOGIT_LIMIT, LOGIT_LIMIT)[None],
        sh.transpose(1, 2, 0).reshape(3 * sh.shape[1], len(sh)),
    )
    return np.ascontiguousarray(np.concatenate(parts))


def _small_rotations(quats: np.ndarray) -> Float32[np.ndarray, "n 3"]:
    """Return x, y, z of the unit quaternion with the largest w for the same ellipsoid.

    A half turn about one of its axes does not change an ellipsoid. In quaternions this turn is the
    product with i, j or k, which moves any component to the place of w.
    """
    q = quats.astype(np.float64)
    length = np.linalg.norm(q, axis=1, keepdims=True)
    q = np.where(length > 1e-30, q / np.maximum(length, 1e-30), (1.0, 0.0, 0.0, 0.0))
    w, x, y, z = q.T
    turned = np.stack(
        [q.T, (x, -w, -z, y), (y, z, -w, -x), (z, -y, x, -w)], 0
    )  # q times 1, -i, -j, -k
    best = turned[np.argmax(np.abs(q), axis=1), :, np.arange(len(q))]
    return (best[:, 1:] * np.where(best[:, :1] < 0, -1, 1)).astype(np.float32)
