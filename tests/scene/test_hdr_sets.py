"""HDR sets and exposure brackets: times and poses are read as they were written."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scene import helpers
from scene.test_transforms import held_out, rows, write_llff
from scipy.spatial.transform import Rotation

from p2gs_jax.config import DataConfig
from p2gs_jax.evaluation.references import find_radiance
from p2gs_jax.formats.exr import write_exr
from p2gs_jax.scene import find_scene
from p2gs_jax.scene.brackets import bracket_notes, brackets
from p2gs_jax.scene.pixels.store import ImageStore
from p2gs_jax.scene.split import assign_split, split_scene
from p2gs_jax.scene.survey import survey

CFG = DataConfig()
TIMES = [0.25, 1.0, 4.0]


def write_truth(path, value):
    path.parent.mkdir(exist_ok=True)
    write_exr(path, np.full((30, 40, 3), value, np.float32))


def radiance_of(scene):
    """Return the true radiance of every view's first pixel, or None."""
    found = find_radiance(scene, ImageStore(scene.views, CFG))
    truth = [found(row) for row in range(len(scene.views))]
    return [None if of_view is None else float(of_view[0, 0, 0]) for of_view in truth]


def write_synthetic(root):
    """Write HDR-NeRF's layout with two poses to train on and one held out."""
    root.mkdir()
    poses = helpers.around(3)
    for part, of_part in (("train", poses[:2]), ("test", poses[2:])):
        data = helpers.blender(of_part, part)
        names = [f"{frame['file_path']}_{e}.png" for frame in data["frames"] for e in range(3)]
        for name in names:
            helpers.write_image(root / name)
        for k in range(len(of_part)):
            write_truth(root / f"{part}_hdr" / f"hdr_{k:03d}.exr", k + 1.5)
        times = dict(zip(names, TIMES * len(of_part), strict=True))
        (root / f"transforms_{part}.json").write_text(json.dumps(data))
        (root / f"exposure_{part}.json").write_text(json.dumps(times))
    return poses


def write_poses(root, numbers=("train_000", "train_001", "test_000")):
    """Write a COLMAP model of one exposure for each pose, and photographs of all; return names."""
    images = helpers.write_tiny_model(root, n=len(numbers)) / "images.txt"
    text = images.read_text()
    for k, number in enumerate(numbers):
        (root / "images" / f"im {k}.png").unlink()
        text = text.replace(f"im {k}.png", f"{number}_1.png")
        for e in range(3):
            helpers.write_image(root / "images" / f"{number}_{e}.png")
    images.write_text(text)
    return [f"{number}_{e}.png" for number in numbers for e in range(3)]


def test_synthetic_scenes_of_hdr_nerf_are_read(tmp_path):
    poses = write_synthetic(tmp_path / "sofa")
    scene = find_scene(tmp_path / "sofa", CFG)
    of_pose = ("test/r_0", "train/r_0", "train/r_1")
    expected = [f"{name}_{e}.png" for name in of_pose for e in range(3)]
    assert [view.name for view in scene.views] == expected
    assert [view.exif_ev for view in scene.views] == [-2.0, 0.0, 2.0] * 3
    assert held_out(scene) == expected[:3]
    centers = [-view.viewmat[:3, :3].T @ view.viewmat[:3, 3] for view in scene.views[::3]]
    np.testing.assert_allclose(centers, poses[[2, 0, 1], :3, 3], atol=1e-5)
    assert radiance_of(scene) == [1.5] * 6 + [2.5] * 3
    assert "3 brackets of 3 exposures." in survey(tmp_path / "sofa", CFG).sentences


def test_models_of_one_exposure_get_the_others_of_each_pose(tmp_path):
    root = tmp_path / "gauss"
    names = write_poses(root)
    # 3DGS writes matrices to a file of this name.
    (root / "exposure.json").write_text('{"train_000_1.png": [[1, 0, 0, 0]]}')
    assert len(find_scene(root, CFG).views) == 3
    (root / "exposure.json").write_text(json.dumps(dict(zip(names, TIMES * 3, strict=True))))
    write_truth(root / "images_hdr" / "test_hdr_000.exr", 7.0)
    scene = find_scene(root, CFG)
    assert [view.name for view in scene.views] == sorted(names)
    assert [view.exif_ev for view in scene.views] == [-2.0, 0.0, 2.0] * 3
    assert held_out(scene) == names[6:]
    assert helpers.reprojection_errors(scene).shape == (9,)
    assert helpers.reprojection_errors(scene).max() < 1e-5
    assert radiance_of(scene) == [7.0] * 3 + [None] * 6
    # HDR-GS has HDR-NeRF's table instead, and other names.
    root = tmp_path / "hdr_gs"
    write_poses(root, ("0", "1"))
    np.save(root / "poses_bounds_exps.npy", np.c_[rows(6), TIMES * 2])
    write_truth(root / "exr" / "1.exr", 3.0)
    scene = find_scene(root, CFG)
    assert [view.exif_ev for view in scene.views] == [-2.0, 0.0, 2.0] * 2
    assert radiance_of(scene) == [None] * 3 + [3.0] * 3
    np.save(root / "poses_bounds_exps.npy", np.c_[rows(5), [1.0] * 5])
    assert "has 5 rows, but" in find_scene(root, CFG).notes[-1]
    # All photographs may be in the model.
    root = tmp_path / "whole"
    helpers.write_tiny_model(root, n=4)
    np.save(root / "poses_bounds_exps.npy", np.c_[rows(), [*TIMES, 1.0]])
    scene = find_scene(root, CFG)
    assert scene.format == "colmap"
    assert [view.exif_ev for view in scene.views] == [-2.0, 0.0, 2.0, 0.0]


def test_settings_of_raw_photographs_are_read(tmp_path):
    helpers.write_tiny_model(tmp_path)
    for k, shutter in enumerate(("1/8", "1/2")):
        helpers.write_image(tmp_path / "raw" / f"im {k}.png")
        settings = [{"ShutterSpeed": shutter, "ISO": 400, "FNumber": 2.0}]
        (tmp_path / "raw" / f"im {k}.json").write_text(json.dumps(settings))
    scene = find_scene(tmp_path, CFG)
    assert [view.exif_ev for view in scene.views] == pytest.approx(np.log2([12.5, 50]))
    assert "exposures of 2 photographs" in scene.notes[-1]
    assert find_scene(tmp_path, DataConfig(images="raw")).views[0].image_path.parent.name == "raw"
    (tmp_path / "raw" / "im 1.json").write_text('[{"ShutterSpeed": -1}]')
    with helpers.refused("im 1.json states an impossible ShutterSpeed"):
        find_scene(tmp_path, CFG)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ('{"train_000_1.png": 0}', "exposure of train_000_1.png is 0"),
        ('{"other.png": 1}', "exposure.json names none of the 3 photographs"),
        ('{"train_000_1.png": 1, "train_000_9.png": 1}', "train_000_9.png"),
        ("{", "exposure.json is not valid JSON"),
    ],
)
def test_broken_files_of_exposures_are_refused(tmp_path, content, message):
    write_poses(tmp_path / "a")
    (tmp_path / "a" / "exposure.json").write_text(content)
    with helpers.refused(message):
        find_scene(tmp_path / "a", CFG)


def test_brackets_of_tables_are_held_out_whole(tmp_path):
    table = np.c_[np.repeat(rows(3), 3, axis=0), TIMES * 3]
    write_llff(tmp_path, table, count=9, folder="input_images")
    path = tmp_path / "poses_bounds_exps.npy"
    (tmp_path / "poses_bounds.npy").rename(path)
    scene = split_scene(find_scene(tmp_path, CFG), DataConfig(test_every=2))
    assert [v.split for v in scene.views] == ["test"] * 3 + ["train"] * 3 + ["test"] * 3
    assert scene.split_by == "every 2nd bracket of each camera"
    assert [v.exif_ev for v in scene.views] == [-2.0, 0.0, 2.0] * 3
    np.save(path, np.c_[rows(9), [1, 1, 0] * 3])
    with helpers.refused("row 2 has the impossible exposure 0"):
        find_scene(tmp_path, CFG)
    for broken, why in ((table[:5], "has 5 rows, but"), (table[:, 1:], "holds 9x17 numbers, not")):
        np.save(path, broken)
        with helpers.refused(f"poses_bounds_exps.npy {why}"):
            find_scene(tmp_path, CFG)


def views_of(path, *shots, end=20.0):
    """Return views of shots (name, x, exposure in EV), and of two more places."""
    shots = (*shots, ("y", end / 2, None), ("z", end, None))
    views = [
        (replace(helpers.make_view(path, at=(x, 0, 0)), exif_ev=ev), name) for name, x, ev in shots
    ]
    return tuple(replace(view, name=f"{name}.png") for view, name in views)


SHOTS = {
    "names": (("a_+0EV", 0, None), ("a_+2ev", 1, None), ("b_exp0", 2, None), ("b_exp1", 3, None)),
    "one pose": (("a1", 0, None), ("a2", 0, None), ("b1", 3, None), ("b2", 3, None)),
    "nearly one": (("a1", 0, 1.0), ("a2", 0.01, 3.0), ("b1", 3, 1.0), ("b2", 3.01, 3.0)),
}
OTHERS = {
    "numbers": (("a_1", 0, None), ("a_2", 1, None), ("b_1", 2, None)),
    "nearly one without exposures": (("a1", 0, None), ("a2", 0.01, None)),
    "one exposure": (("a1", 0, 1.0), ("a2", 0.01, 1.1)),
    "apart": (("a1", 0, 1.0), ("a2", 0.5, 3.0)),
}


@pytest.mark.parametrize("shots", SHOTS.values(), ids=SHOTS)
def test_brackets_are_found_by_names_poses_or_exposures(tmp_path, shots):
    views = views_of(tmp_path, *shots)
    assert brackets(views) == [0, 0, 2, 2, 4, 5]
    assert bracket_notes(brackets(views)) == ["2 brackets of 2 exposures."]
    assert [v.split for v in assign_split(views, 2)][:4] == ["test", "test", "train", "train"]


@pytest.mark.parametrize("shots", OTHERS.values(), ids=OTHERS)
def test_other_photographs_are_not_brackets(tmp_path, shots):
    views = views_of(tmp_path, *shots)
    assert brackets(views) == [*range(len(views))]
    still = views_of(tmp_path, ("a", 0.0, None), ("b", 0.0, None), end=0.0)
    assert brackets(still) == [0, 1, 2, 3]
    # The mean of equal centres may differ from them by rounding.
    turn = Rotation.from_euler("xyz", (15, 20, 30), degrees=True).as_matrix()
    viewmat = np.eye(4, dtype=np.float32)
    viewmat[:3] = np.c_[turn, (0.1, -3.7, 11.3)]
    turned = replace(still[0], viewmat=viewmat)
    assert brackets([replace(turned, name=f"{k}.png") for k in range(10)]) == [*range(10)]


def test_brackets_of_photographs_alone_are_found_by_names(tmp_path):
    for name in ("a_-2EV", "a_0EV", "a_+2EV", "b_-2EV", "b_0EV", "c"):
        helpers.write_image(tmp_path / f"{name}.png")
    assert survey(tmp_path, CFG).sentences[0] == "2 brackets of 2 to 3 exposures."
