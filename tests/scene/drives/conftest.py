"""Synthetic drives of each format, to read and to change."""

import shutil
from pathlib import Path

import pytest
from scene.drives import writers_argoverse as argoverse
from scene.drives import writers_drivestudio as drivestudio
from scene.drives import writers_kitti as kitti
from scene.drives import writers_kitti_tracking as kitti_tracking
from scene.drives import writers_nuscenes as nuscenes
from scene.drives import writers_pandaset as pandaset
from scene.drives import writers_waymo as waymo

from p2gs_jax.config import DataConfig
from p2gs_jax.scene.drives import read_drive

WRITERS = {
    **{"argoverse": argoverse, "kitti_raw": kitti, "kitti_tracking": kitti_tracking},
    **{"nuscenes": nuscenes, "pandaset": pandaset, "waymo": waymo, "drivestudio": drivestudio},
}


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
