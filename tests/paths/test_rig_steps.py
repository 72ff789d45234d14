import numpy as np
import pytest
from cameras import turned, view

from p2gs_jax.errors import UserError
from p2gs_jax.paths.rig import find_rig
from p2gs_jax.paths.shots import view_shots
from p2gs_jax.scene.rigid import inverse

MOUNTS = {
    "front": turned(2, (0, 0.1, 0.5), pitch=3, roll=1),
    "left": turned(-45, (-0.4, 0, 0.2), pitch=3),
    "right": turned(45, (0.4, -0.1, 0.2), pitch=3),
}


def vehicle(step):
    """Return vehicle-to-world on a curved road."""
    return inverse(turned(8 * step, (0.3 * step**2, 0, 2.0 * step)))


def photographs(steps=4, mounts=MOUNTS, leave_out=()):
    out = [
        view(f"{camera}/{k:06d}.png", mount @ inverse(vehicle(k)))
        for camera, mount in mounts.items()
        for k in range(steps)
        if (camera, k) not in leave_out
    ]
    return sorted(out, key=lambda v: v.name)


def rig_of(views):
    return find_rig(view_shots(views), views)


def test_steps_are_found_by_name_and_cameras_are_placed_on_the_rig():
    views = photographs()
    rig = rig_of(views)
    assert [s.name for s in rig.steps] == [f"{k:06d}" for k in range(4)]
    for step in rig.steps:
        assert sorted(step.shots) == sorted(MOUNTS)
        for camera, shot in step.shots.items():
            np.testing.assert_allclose(
                rig.mounts[camera].viewmat @ inverse(step.pose), shot.viewmat, atol=1e-6
            )


def test_the_rig_is_centred_and_level():
    rig = rig_of(photographs())
    centers = np.stack([inverse(s.viewmat)[:3, 3] for s in rig.mounts.values()])
    np.testing.assert_allclose(centers.mean(0), 0, atol=1e-9)
    step = rig.steps[0]
    np.testing.assert_allclose(step.pose[:3, 1], [0, 1, 0], atol=0.02)  # down stays down
    assert np.rad2deg(np.arccos(step.pose[2, 2])) < 2  # forward stays forward


def test_missing_photographs_do_not_move_the_rig():
    full = rig_of(photographs())
    some = rig_of(photographs(leave_out={("left", 0), ("right", 2), ("left", 3), ("front", 3)}))
    assert [s.name for s in some.steps] == ["000000", "000001", "000002"]
    assert sorted(some.steps[0].shots) == ["front", "right"]
    for k in range(3):
        np.testing.assert_allclose(some.steps[k].pose, full.steps[k].pose, atol=1e-5)


def test_one_camera_is_no_rig():
    views = photographs(mounts={"front": MOUNTS["front"]})
    with pytest.raises(UserError, match="one camera"):
        rig_of(views)


def test_names_that_never_agree_are_no_rig():
    views = [view(f"{c}/{c}_{k}.png", turned(0, (0, 0, k))) for c in "ab" for k in range(3)]
    with pytest.raises(UserError, match="never agree"):
        rig_of(views)


def test_cameras_that_turn_against_each_other_are_no_rig():
    views = [view(f"a/{k}.png", turned(0, (0, 0, k))) for k in range(4)]
    views += [view(f"b/{k}.png", turned(40 * k, (0, 0, k))) for k in range(4)]
    with pytest.raises(UserError, match="turn against each other"):
        rig_of(views)


def test_a_camera_that_is_never_there_with_the_others_is_named():
    views = photographs()
    views += [view("back/000099.png", turned(180))]
    with pytest.raises(UserError, match="'back'"):
        rig_of(views)
