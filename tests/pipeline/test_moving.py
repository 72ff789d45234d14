"""A drive with a box that crosses before the cameras: fits, rendering, exports and scores."""

import dataclasses
import json
import shutil

import numpy as np
import pytest
from moving_box import SIZE, drive_format, pose_at, write_photographs

from p2gs_jax import FitConfig, UserError, develop, fit, load_run, make_camera, with_fields
from p2gs_jax.core.atomic import read_jsonl
from p2gs_jax.formats.exr import read_exr
from p2gs_jax.formats.ply import read_ply
from p2gs_jax.render.project import STILL, at_time
from p2gs_jax.run.checkpoint import saved_steps
from p2gs_jax.run.scene_file import read_objects
from p2gs_jax.scene import drives
from p2gs_jax.scene.drives.objects import object_mask

FIELDS = {"data.format": "pandaset", "data.ego_mask": False, "data.frames": "::2"}
FIELDS |= {"data.test_every": 4, "train.steps": 20, "train.log_every": 5}
FIELDS |= {"train.coarse_to_fine": (), "train.checkpoint_every_s": 0.0}
FIELDS |= {"render.sh_degree": 0, "render.pixels_in_flight": 2048}
FIELDS |= {"densify.max_gaussians": 3000, "densify.min_every_steps": 5}
FIELDS |= {"init.dense": "off", "init.shell": "off"}
FIELDS |= {"photometry.select": False, "photometry.model": "view_exposure"}
SHORT = with_fields(FitConfig(), FIELDS)
METHODS = {
    "rigid": SHORT,
    **{name: with_fields(SHORT, {"dynamics.method": name}) for name in ("mask", "off")},
    "vibration": with_fields(SHORT, {"dynamics.method": "vibration", "dynamics.vibrating": 600}),
    "adaptive": with_fields(SHORT, {"densify.method": "adaptive", "densify.grad_threshold": 0.0}),
}
SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in ("vibration", "adaptive")]


@pytest.fixture(scope="module", autouse=True)
def _reader():
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(drives.FORMATS, "pandaset", drive_format())
        yield


@pytest.fixture(scope="module")
def folder(made_once):
    return made_once("moving_box", write_photographs)


@pytest.fixture(scope="module")
def fitted(folder, made_once):
    """Return a function from a method to its finished run, which every test only reads."""

    def run_of(method):
        return made_once(f"moving_{method}", lambda run: fit(folder, run, METHODS[method]))

    return run_of


@pytest.fixture(scope="module")
def run(fitted):
    return load_run(fitted("rigid"))


def test_the_run_stores_the_owner_of_each_gaussian_and_the_boxes(run):
    assert run.owner is not None
    assert run.moving is not None
    assert set(run.owner) == {-1, 0}
    assert (
        len(run.owner)
        == run.params.gaussians.capacity
        == len(read_ply(run.folder / "radiance.ply").means)
    )
    (box,) = run.moving.objects
    assert box is run.scene.objects[0]
    assert box.size == SIZE
    mine = np.asarray(run.params.gaussians.means)[run.owner == 0]
    assert (np.abs(mine) < np.array(SIZE)).all(1).mean() > 0.95
    metrics = json.loads((run.folder / "metrics.json").read_text())
    assert {"whole", "static", "moving"} <= set(metrics["test"]["exposure_fitted"])
    assert "1 moving objects have separate Gaussians" in " ".join(metrics["notes"])


def test_views_are_rendered_at_their_own_time(run):
    """The pictures with the box and without it differ where the box is."""
    for index in (0, 12):
        view = run.scene.views[index]
        camera = run.camera(index)
        with_box = np.asarray(run.render(camera).linear)
        without = np.asarray(run.without_objects().render(camera).linear)
        plain = dataclasses.replace(camera, objects=None)
        np.testing.assert_array_equal(without, run.render(plain).linear)
        np.testing.assert_allclose(run.render(plain, view.time).linear, with_box, atol=1e-5)
        # A new camera shows the box only if a time is given.
        viewmat, K, width, height = run.store.camera(index)
        new = make_camera(K, viewmat, width, height)
        np.testing.assert_array_equal(run.render(new).linear, without)
        np.testing.assert_allclose(run.render(new, view.time).linear, with_box, atol=1e-4)
        changed = np.abs(with_box - without).max(-1) > 0.1
        inside = object_mask(view, run.scene.objects, camera.width, camera.height, 0.3)
        assert changed.sum() > 100
        assert (changed & ~inside).sum() < 0.1 * changed.sum()


def test_only_objects(run):
    camera = run.camera(4)
    alone = run.only_objects()
    assert alone.params.gaussians.capacity == (run.owner == 0).sum()
    alpha = np.asarray(alone.render(camera).alpha)
    inside = object_mask(run.scene.views[4], run.scene.objects, camera.width, camera.height, 0.4)
    assert alpha[inside].max() > 0.5
    assert alpha[~inside].mean() < 0.02
    still = dataclasses.replace(run, owner=None, moving=None)
    for refused in (still.only_objects, still.without_objects):
        with pytest.raises(UserError, match="no moving object"):
            refused()


def test_the_command_renders_what_moves(run, tmp_path, succeeded, refused):
    base = ("render", run.folder, "--split", "test", "--camera", "cam0")
    options = {"all": (), "without": ("--without-objects",), "only": ("--only-objects",)}
    # The cameras of a path can be rendered again, as they were.
    options |= {"drive": ("--trajectory", "drive", "--frames", "3")}
    options |= {"again": ("--trajectory", tmp_path / "drive" / "cameras.json")}
    options["views"] = ("--panorama", "--split", "train", "--width", "120")
    options["wide"] = ("--panorama", "--trajectory", "drive", "--frames", "2", "--width", "120")
    options["part"] = (*options["wide"], "--split", "train")
    options["bare"] = (*options["wide"], "--without-objects")
    contents = {}
    for name, extra in options.items():
        words = base if name in ("all", "without", "only", "drive") else base[:2]
        succeeded(*words, *extra, "--out", tmp_path / name)
        contents[name] = [p.read_bytes() for p in sorted((tmp_path / name).rglob("*.exr"))]
        assert contents[name]
    assert len({contents[name][0] for name in ("all", "without", "only")}) == 3
    assert contents["again"] == contents["drive"]
    assert contents["wide"][0] not in (contents["bare"][0], contents["part"][0])
    succeeded(*base[:2], *options["wide"], "--out", tmp_path / "views", "--overwrite")
    left = [p.read_bytes() for p in sorted((tmp_path / "views").rglob("*.exr"))]
    assert left == contents["wide"] != contents["views"]
    shots = json.loads((tmp_path / "drive" / "cameras.json").read_text())
    assert [s["time"] for s in shots] == sorted(s["time"] for s in shots)
    assert shots[0]["time"] == 0.0
    refused(*base, "--without-objects", "--only-objects", "--out", tmp_path / "x")


def test_exports_hold_the_middle_of_the_drive(run, tmp_path, succeeded):
    command = ("export", run.folder, "--format", "linear-ply", "--out")
    succeeded(*command, tmp_path / "all")
    succeeded(*command, tmp_path / "still", "--without-objects")
    everything = read_ply(tmp_path / "all" / "linear.ply")
    still = read_ply(tmp_path / "still" / "linear.ply")
    assert everything.capacity == run.params.gaussians.capacity
    assert still.capacity == (run.owner < 0).sum()
    times = sorted(v.time for v in run.scene.training_views)
    pose = pose_at(times[len(times) // 2])
    mine = np.asarray(everything.means)[run.owner == 0]
    assert np.abs(np.median(mine, 0) - pose[:3, 3]).max() < 0.5
    shown = read_ply(run.folder / "splats.ply")
    np.testing.assert_allclose(shown.means, everything.means, atol=1e-5)


def test_scores_can_be_computed_again(run, tmp_path, succeeded):
    before = json.loads((run.folder / "metrics.json").read_text())
    again = tmp_path / "run"
    shutil.copytree(run.folder, again)
    succeeded("eval", again)
    after = json.loads((again / "metrics.json").read_text())
    for part in (lambda m: m["train"], lambda m: m["test"]["exposure_fitted"]):
        found, expected = (part(scores)["moving"]["psnr"] for scores in (after, before))
        assert found == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize("method", ["rigid", *SLOW])
def test_a_resumed_run_is_the_one_that_was_never_stopped(fitted, folder, tmp_path, method):
    whole, out = fitted(method), tmp_path / "run"
    shutil.copytree(whole, out)
    steps = saved_steps(out / "checkpoints")
    assert steps[-1] == SHORT.train.steps
    shutil.rmtree(out / "checkpoints" / str(steps[-1]))
    for name in ("radiance.ply", "photometry.json", "objects.npz", "metrics.json"):
        (out / name).unlink()
    fit(folder, out, METHODS[method], resume=True)
    for name in ("radiance.ply", "photometry.json"):
        assert (out / name).read_bytes() == (whole / name).read_bytes(), name
    with np.load(out / "objects.npz") as a, np.load(whole / "objects.npz") as b:
        assert set(a) == set(b)
        for key in a:
            np.testing.assert_array_equal(a[key], b[key])
    steps = [line["step"] for line in read_jsonl(out / "log.jsonl")]
    assert steps == list(range(5, SHORT.train.steps + 1, 5))


@pytest.mark.slow
def test_gaussians_that_vibrate_are_shown_at_the_time_of_each_view(fitted):
    run = load_run(fitted("vibration"))
    moves = run.params.gaussians.vibration
    still = np.asarray(moves.log_lives) > np.log(STILL) - 1e-3
    assert 0.2 < still.mean() < 0.9
    assert not np.any(np.asarray(moves.velocities)[still])
    assert np.abs(np.asarray(moves.velocities)[~still]).max() > 0.5
    index = run.scene.test_indices[0]
    shown = np.asarray(run.render(run.camera(index)).linear)
    name = run.scene.views[index].name.rsplit(".", 1)[0]
    stored, *_ = read_exr(run.folder / "renders" / f"{name}.exr")
    np.testing.assert_allclose(stored, shown, atol=2e-3)
    later = np.asarray(run.render(run.camera(index), run.scene.views[index].time + 0.5).linear)
    assert np.abs(later - shown).max() > 0.02
    empty = run.without_objects()
    assert empty.params.gaussians.capacity == still.sum()
    without = np.asarray(empty.render(empty.camera(index)).linear)
    assert np.abs(without - shown).max() > 0.02
    # Files for other programs are of one moment.
    assert read_ply(run.folder / "splats.ply").vibration is None
    assert at_time(run.as_of(), None).vibration is None


def test_broken_or_foreign_owners_are_refused(run, tmp_path):
    path = tmp_path / "objects.npz"
    path.write_bytes((run.folder / "objects.npz").read_bytes()[:100])
    with pytest.raises(UserError, match="cannot be read"):
        read_objects(path, run.scene, len(run.owner))
    with pytest.raises(UserError, match="does not belong"):
        read_objects(run.folder / "objects.npz", run.scene, 5)
    assert read_objects(tmp_path / "none.npz", run.scene, 5) == (None, None)


@pytest.mark.slow
def test_rigid_beats_mask_inside_the_box_and_equals_it_elsewhere(fitted):
    inside, outside = {}, {}
    for method in ("rigid", "mask", "off"):
        done, errors = load_run(fitted(method)), ([], [])
        for index in done.scene.test_indices:
            camera, view = done.camera(index), done.scene.views[index]
            shown = develop(done.render(camera).linear, done.own_display(index))
            squared = ((np.clip(shown, 0, 1) - done.photograph(index)) ** 2).mean(-1)
            size = (camera.width, camera.height)
            errors[0].append(squared[object_mask(view, done.scene.objects, *size, 0.0)])
            errors[1].append(squared[~object_mask(view, done.scene.objects, *size, 0.3)])
        inside[method], outside[method] = (
            -10 * np.log10(np.concatenate(part).mean()) for part in errors
        )
    assert inside["rigid"] > max(inside["mask"], inside["off"]) + 10
    assert outside["rigid"] > max(outside["mask"], outside["off"]) - 0.5
