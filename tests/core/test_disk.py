"""A write without room raises an error that names the file, and leaves the old file as it was."""

import contextlib
import errno
import resource

import numpy as np
import pytest

from p2gs_jax.core.atomic import append_jsonl, naming, read_jsonl, write_text
from p2gs_jax.formats.exr import write_exr
from p2gs_jax.formats.frames import write_png
from p2gs_jax.synth.write import write_street


@contextlib.contextmanager
def room_for(size):
    """Limit the files of this process to so many bytes, like a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


NOISE = np.random.default_rng(0).random((64, 64, 3), np.float32)
WRITERS = {
    "a.txt": lambda path: write_text(path, "x" * 9000),
    "a.png": lambda path: write_png(path, NOISE),
    "a.exr": lambda path: write_exr(path, NOISE),
}


@pytest.mark.parametrize("name", WRITERS)
def test_a_write_to_a_full_disk_names_its_file(tmp_path, name):
    path = tmp_path / name
    path.write_text("before")
    with room_for(4096), pytest.raises(OSError, match=r".") as error:
        WRITERS[name](path)
    assert error.value.errno == errno.EFBIG
    assert error.value.filename == str(path)
    assert [p.name for p in tmp_path.iterdir()] == [name]
    assert path.read_text() == "before"


def test_a_synthetic_scene_on_a_full_disk_names_its_folder(tmp_path):
    out = tmp_path / "town"
    with room_for(2048), pytest.raises(OSError, match=r".") as error:
        write_street(out, frames=1, width=48, height=32, points=50)
    assert (error.value.errno, error.value.filename) == (errno.EFBIG, str(out))
    assert list(tmp_path.iterdir()) == []


def test_a_log_on_a_full_disk_is_named_and_mended(tmp_path):
    path = tmp_path / "log.jsonl"
    append_jsonl(path, {"step": 1})
    with room_for(20), pytest.raises(OSError, match=r".") as error:
        append_jsonl(path, {"step": 2, "text": "x" * 50})
    assert (error.value.errno, error.value.filename) == (errno.EFBIG, str(path))
    assert path.stat().st_size == 20, "the last line was cut"
    append_jsonl(path, {"step": 3})
    assert read_jsonl(path) == [{"step": 1}, {"step": 3}]


def test_other_errors_stay_as_they_are(tmp_path):
    with pytest.raises(RuntimeError, match="why"), naming(tmp_path / "a"):
        raise RuntimeError("why")
    assert list(tmp_path.iterdir()) == []
