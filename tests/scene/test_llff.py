"""LLFF's poses_bounds.npy: axes, sizes, and broken copies."""

import cv2
import numpy as np
import pytest
from scene.posed import around

from p2gs_jax.config import DataConfig
from p2gs_jax.errors import UserError
from p2gs_jax.scene import find_scene

CFG = DataConfig()


def rows(count=4, size=(40, 30), focal=50.0):
    """Return what LLFF writes for cameras on a ring."""
    out = []
    for pose in around(count):
        # OpenGL's right, up, backwards; LLFF's down, right, backwards.
        right, up, back = pose[:3, :3].T
        hwf = [size[1], size[0], focal]
        matrix = np.stack([-up, right, back, pose[:3, 3], hwf], 1)
        out.append([*matrix.ravel(), 2.0, 6.0])
    return np.array(out)


def write(root, table, count=4, size=(40, 30), folder="images"):
    (root / folder).mkdir(parents=True, exist_ok=True)
    for k in range(count):
        image = np.full((size[1], size[0], 3), 100, np.uint8)
        assert cv2.imwrite(str(root / folder / f"{k}.png"), image)
    np.save(root / "poses_bounds.npy", table)
    return root


def test_axes_and_lens(tmp_path):
    scene = find_scene(write(tmp_path, rows()), CFG)
    assert scene.format == "llff"
    assert scene.depths == (2.0, 6.0)
    for view, pose in zip(scene.views, around(4), strict=True):
        expected = np.linalg.inv(pose @ np.diag([1.0, -1.0, -1.0, 1.0]))
        assert np.allclose(view.viewmat, expected, atol=1e-6)
        assert np.allclose(view.K, [[50, 0, 20], [0, 50, 15], [0, 0, 1]])
    # The middle of the ring lies in the middle of every picture, four units ahead.
    assert np.allclose([view.viewmat[:3, 3] for view in scene.views], [0, 0, 4], atol=1e-6)


def test_smaller_photographs_are_named_by_their_folder(tmp_path):
    write(tmp_path, rows(), size=(20, 15), folder="images_2")
    scene = find_scene(tmp_path, DataConfig(images="images_2"))
    assert np.allclose(scene.views[0].K, [[25, 0, 10], [0, 25, 7.5], [0, 0, 1]])
    assert "4 images have another size" in scene.notes[0]


def nan_bounds(table):
    table[1, 16] = np.nan


def swapped_bounds(table):
    table[1, 15:] = 6, 2


def nan_pose(table):
    table[2, 3] = np.inf


def no_focal(table):
    table[0, 14] = 0


def mirrored(table):
    table[3, [0, 5, 10]] *= -1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (nan_bounds, "row 1 has impossible bounds: 2 to nan"),
        (swapped_bounds, "row 1 has impossible bounds: 6 to 2"),
        (nan_pose, "the pose in row 2 is not finite"),
        (no_focal, "row 0 has an impossible height, width or focal length"),
        (mirrored, "row 3 is not a rotation"),
    ],
)
def test_broken_tables(tmp_path, change, message):
    table = rows()
    change(table)
    with pytest.raises(UserError, match=message) as info:
        find_scene(write(tmp_path, table), CFG)
    assert "poses_bounds.npy" in str(info.value)


def test_broken_files(tmp_path):
    root = write(tmp_path, rows())
    path = root / "poses_bounds.npy"
    whole = path.read_bytes()
    for size in (0, 5, 40, len(whole) - 8):
        path.write_bytes(whole[:size])
        with pytest.raises(UserError, match=r"poses_bounds.npy cannot be read"):
            find_scene(root, CFG)
    np.save(path, np.array([{"a": 1}], dtype=object), allow_pickle=True)
    with pytest.raises(UserError, match=r"poses_bounds.npy cannot be read"):
        find_scene(root, CFG)
    np.save(path, np.array(["a"]))
    with pytest.raises(UserError, match="holds no numbers"):
        find_scene(root, CFG)
    np.save(path, rows()[:, :15])
    with pytest.raises(UserError, match="holds 4x15 numbers, not N x 17"):
        find_scene(root, CFG)


def test_photographs_and_rows_must_be_as_many(tmp_path):
    write(tmp_path, rows(), count=3)
    with pytest.raises(UserError, match=r"has 4 rows, and .*images holds 3 photographs"):
        find_scene(tmp_path, CFG)
    write(tmp_path, rows(), size=(40, 40))
    with pytest.raises(UserError, match="wrong size"):
        find_scene(tmp_path, CFG)
