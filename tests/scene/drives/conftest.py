"""Synthetic drives of each format, to read and to change."""

import shutil
from importlib import import_module
from pathlib import Path

import pytest

from p2gs_jax.config import DataConfig
from p2gs_jax.scene.drives import FORMATS, read_drive

WRITERS = {n: import_module(f"scene.drives.writers_{n.removesuffix('_raw')}") for n in FORMATS}


@pytest.fixture(scope="session")
def write():
    """Return a function that writes a drive of a format and returns it with its truth."""
    return lambda name, root, **options: WRITERS[name].write(root, **options)


@pytest.fixture(scope="session")
def read():
    """Return a function that reads the drive of any format in a folder."""

    def get(root, **choice):
        recording = read_drive(root, DataConfig(**choice), print)
        assert recording is not None
        return recording

    return get


@pytest.fixture(scope="session")
def kept(tmp_path_factory):
    """Return a function from a format to a drive that is only read."""
    made = {}

    def get(name):
        if name not in made:
            made[name] = WRITERS[name].write(tmp_path_factory.mktemp(name) / "drive")
        return made[name]

    return get


@pytest.fixture
def copied(kept, tmp_path):
    """Return a function from a format to a drive that may be changed."""

    def get(name):
        made = kept(name)
        return made._replace(root=Path(shutil.copytree(made.root, tmp_path / made.root.name)))

    return get
