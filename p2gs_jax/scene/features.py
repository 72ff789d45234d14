"""SIFT features and matches in a COLMAP database, and which image pairs to match."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from itertools import combinations
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Float

from p2gs_jax.config import Matching
from p2gs_jax.errors import UserError
from p2gs_jax.scene.colmap import subfolder

MAX_IMAGE_SIZE = 1600
MAX_FEATURES = 4096
EXHAUSTIVE_LIMIT = 60
"""Up to this many images every pair is matched."""
_OVERLAP, _LOOPS_EVERY = 10, 5
# With known poses (nerf_fox, 50 views of 540x960, processor time): the nearest 20 give 574 pairs in
# 71 s and 11,961 points, the nearest 10 292 pairs in 53 s and 12,017 points.
_NEIGHBOURS = 10
_EXHAUSTIVE_LIMIT_BY_POSE = _NEIGHBOURS + 5

Pair = tuple[str, str]


def quiet_colmap() -> None:
    """Set COLMAP's log to errors only; otherwise it reports progress."""
    pycolmap.logging.minloglevel = int(pycolmap.logging.ERROR)


def extract(
    database: Path,
    image_folder: Path,
    names: Sequence[str],
    *,
    mode: pycolmap.CameraMode,
    enlarge: bool = True,
    camera: int | None = None,
) -> None:
    """Detect SIFT features on the CPU and store them.

    Args:
        database: created where it does not exist.
        image_folder: what `names` are relative to.
        names: images to read.
        mode: how the images share cameras.
        enlarge: look for features in images of twice the size as well.
        camera: of the database, which took them; None: a new one, or more.

    Raises:
        UserError: COLMAP failed.
    """
    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size = MAX_IMAGE_SIZE
    options.sift.max_num_features = MAX_FEATURES
    if not enlarge:
        options.sift.first_octave = 0
    reader = pycolmap.ImageReaderOptions()
    if camera is not None:
        reader.existing_camera_id = camera
    try:
        pycolmap.extract_features(
            database,
            image_folder,
            image_names=list(names),
            camera_mode=mode,
            reader_options=reader,
            extraction_options=options,
            device=pycolmap.Device.cpu,
        )
    except (RuntimeError, ValueError, OSError) as error:
        raise UserError(
            f"COLMAP could not extract features in {image_folder}: {error}.",
            fix="look for an image there that does not open, and remove or replace it",
        ) from error


def match(database: Path, pairs: Iterable[Pair] | None) -> None:
    """Match features on the CPU.

    Args:
        database: with features.
        pairs: names of the images to match; None matches every pair.
    """
    cpu = pycolmap.Device.cpu
    if pairs is None:
        pycolmap.match_exhaustive(database, device=cpu)
        return
    pairs = list(pairs)
    if not quotable([name for pair in pairs for name in pair]):
        pycolmap.match_sequential(database, device=cpu)
        return
    listing = database.with_name("pairs.txt")
    listing.write_text("".join(f"{a} {b}\n" for a, b in pairs))
    options = pycolmap.ImportedPairingOptions()
    options.match_list_path = listing
    pycolmap.match_image_pairs(database, pairing_options=options, device=cpu)


def quotable(names: Iterable[str]) -> bool:
    """Whether COLMAP can read these names in a list of pairs: blanks separate them there."""
    return not any(" " in name for name in names)


def pairs_by_name(names: Sequence[str], matching: Matching = "auto") -> list[Pair] | None:
    """Return the pairs to match by their names alone; None means all.

    Sequences, one a top folder: each image meets the next 10 and those 16, 32, ... 512 later; where
    a sequence is asked for, every fifth also meets every other fifth, for who comes back to a
    place; images of different folders meet at the same place in the sequence and next to it
    (COLMAP's sequential matching would never match `left/` with `right/`).

    Args:
        names: of the images.
        matching: `sequence`, `all`, or `auto`: long lists are sequences.
    """
    if matching == "all" or (matching == "auto" and len(names) <= EXHAUSTIVE_LIMIT):
        return None
    sequences: dict[str | None, list[str]] = defaultdict(list)
    for name in sorted(names):
        sequences[subfolder(name)].append(name)
    steps = [*range(1, _OVERLAP + 1), *(2**k for k in range(4, 10))]
    pairs: list[Pair] = []
    lists = list(sequences.values())
    for i, a in enumerate(lists):
        near = [(k, k + s) for s in steps for k in range(len(a) - s)]
        far = combinations(range(0, len(a), _LOOPS_EVERY), 2) if matching == "sequence" else ()
        pairs += [(a[k], a[m]) for k, m in dict.fromkeys([*near, *far])]
        for b in lists[i + 1 :]:
            pairs += [
                (a[k], b[k + s]) for s in (-1, 0, 1) for k in range(len(a)) if 0 <= k + s < len(b)
            ]
    return pairs


def pairs_by_pose(names: Sequence[str], viewmats: Float[np.ndarray, "v 4 4"]) -> list[Pair] | None:
    """Return the pairs to match where poses are known; None means all.

    Each image meets the 10 nearest cameras that look less than 75 degrees another way.

    Args:
        names: of the images.
        viewmats: their world-to-camera poses.
    """
    if len(names) <= _EXHAUSTIVE_LIMIT_BY_POSE:
        return None
    rotations = viewmats[:, :3, :3].astype(np.float64)
    centres = -np.einsum("vji,vj->vi", rotations, viewmats[:, :3, 3])
    directions = rotations[:, 2]
    pairs: set[tuple[int, int]] = set()
    for i in range(len(names)):
        distance = np.linalg.norm(centres - centres[i], axis=1)
        distance[directions @ directions[i] < np.cos(np.radians(75.0))] = np.inf
        distance[i] = np.inf
        nearest = np.argsort(distance, kind="stable")[:_NEIGHBOURS]
        pairs |= {(min(i, int(j)), max(i, int(j))) for j in nearest if np.isfinite(distance[j])}
    return [(names[i], names[j]) for i, j in sorted(pairs)]
