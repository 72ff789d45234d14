"""The protocols of `metrics.json`: which views a score is of, and how they are shown."""

from __future__ import annotations

from typing import NamedTuple


class Protocol(NamedTuple):
    """A way to show views for a score."""

    views: str  # which, in words
    shown: str  # at which exposure, in words
    path: tuple[str, ...]  # where `metrics.json` has the scores


PROTOCOLS = {
    "train": Protocol("training", "own exposure and gamma", ("train",)),
    "train_averaged": Protocol("training", "mean exposure and gamma", ("train", "averaged")),
    "test_averaged": Protocol("held out", "mean exposure and gamma", ("test", "averaged")),
    "test_fitted": Protocol(
        "held out", "exposure fitted to each photograph", ("test", "exposure_fitted")
    ),
    "test_all_fitted": Protocol(
        "held out",
        "all that varies per view fitted to each photograph",
        ("test", "photometry_fitted"),
    ),
    "test_metered": Protocol(
        "held out", "exposure metered, as the camera would", ("test", "metered")
    ),
    "reference_averaged": Protocol(
        "all", "reference photographs, mean exposure", ("reference", "averaged")
    ),
    "reference_geometric": Protocol(
        "all", "reference photographs, geometric mean exposure", ("reference", "geometric")
    ),
    "reference": Protocol(
        "all", "reference photographs, one scale for all", ("reference", "scale_aligned")
    ),
    "reference_test": Protocol(
        "held out",
        "reference photographs, one scale for all",
        ("reference", "scale_aligned", "test"),
    ),
}
