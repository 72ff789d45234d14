"""Why photographs did not register: what the database knows of them."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path

import pycolmap

# Fewer features than this seldom give a pose.
FEW_FEATURES = 100
# Of a verified pair; COLMAP takes no fewer.
LEAST_INLIERS = 15


def reasons(
    database: Path, names: Sequence[str], models: Sequence[pycolmap.Reconstruction]
) -> dict[str, str]:
    """Return for every photograph that is not in the first model why not, in words.

    Args:
        database: features and matches.
        names: of all photographs.
        models: what was reconstructed; the first is used.
    """
    parts = [{model.image(i).name for i in model.reg_image_ids()} for model in models]
    used = parts[0] if parts else set()
    left = [name for name in names if name not in used]
    if not left:
        return {}
    features, partners = _known(database)
    return {name: _why(name, features, partners, parts) for name in left}


def sentence(why: Mapping[str, str]) -> str:
    """Return the photographs and the reasons, those of one reason together."""
    by_reason: dict[str, list[str]] = defaultdict(list)
    for name, reason in why.items():
        by_reason[reason].append(name)
    return "; ".join(f"{', '.join(names)} ({reason})" for reason, names in by_reason.items())


def _why(
    name: str,
    features: Mapping[str, int],
    partners: Mapping[str, Mapping[str, int]],
    parts: Sequence[set[str]],
) -> str:
    count = features.get(name, 0)
    if count == 0:
        return "no features: it does not open, or shows nothing"
    met = partners.get(name, {})
    few = f"only {count} features: blurred, dark or without texture"
    if not met:
        return few if count < FEW_FEATURES else "looks like no other photograph"
    own = next((part for part in parts[1:] if name in part), None)
    if own is not None:
        return f"in a part of {len(own)} photographs that shares too little with the rest"
    here = {other: inliers for other, inliers in met.items() if parts and other in parts[0]}
    if not here:
        return "matches only photographs that did not register either"
    if count < FEW_FEATURES:
        return few
    best = max(here, key=lambda other: here[other])
    return (
        f"{here[best]} matches with {best}, its best of {len(here)}: too few of them are points "
        "that others see too"
    )


def _known(database: Path) -> tuple[dict[str, int], dict[str, dict[str, int]]]:
    """Return the number of features of every photograph, and its verified matches by partner."""
    db = pycolmap.Database.open(database)
    try:
        images = {image.image_id: image.name for image in db.read_all_images()}
        features = {name: db.num_keypoints_for_image(i) for i, name in images.items()}
        partners: dict[str, dict[str, int]] = defaultdict(dict)
        pairs, counts = db.read_two_view_geometry_num_inliers()
        for pair, inliers in zip(pairs, counts, strict=True):
            a, b = (images[i] for i in pycolmap.pair_id_to_image_pair(pair))
            if inliers >= LEAST_INLIERS:
                partners[a][b] = partners[b][a] = int(inliers)
        return features, partners
    finally:
        db.close()
