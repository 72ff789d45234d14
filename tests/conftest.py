"""Shared fixtures; real data is used where it lies beside the checkout and skipped elsewhere."""

from pathlib import Path

import pytest

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture
def shared_data():
    """Return a function from a data-set name to its folder, skipping where it is absent."""

    def find(name: str) -> Path:
        folder = SHARED / name
        if not folder.is_dir():
            pytest.skip(f"real data set {name!r} is not beside this checkout ({folder})")
        return folder

    return find
