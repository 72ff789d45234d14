"""Which sizes exist, and which of them the next frame takes."""

import numpy as np

from p2gs_jax.viewer.ladder import (
    CLIMB,
    FALL,
    TARGET_MS,
    Pace,
    choose,
    expected_ms,
    full_size,
    ladder,
    order_of_compilation,
)

RUNGS = ((320, 200), (480, 300), (1280, 800))


def test_the_canvas_itself_up_to_a_width():
    assert full_size((1280, 800), 1920) == (1280, 800)
    assert full_size((3840, 2160), 1920) == (1920, 1080)
    assert full_size((0, 0), 1920) == (1, 1)


def test_a_ladder_rises_to_the_full_size():
    for canvas in ((1280, 800), (1920, 950), (600, 1000), (200, 150), (1, 1)):
        rungs = ladder(canvas)
        areas = [w * h for w, h in rungs]
        assert areas == sorted(set(areas))
        assert rungs[-1] == canvas
        assert set(order_of_compilation(rungs)) == set(rungs)
        assert all(w % 8 == h % 8 == 0 for w, h in rungs[:-1])


def test_windows_of_nearly_the_same_shape_share_programs():
    shared = {rung for width in range(1250, 1350) for rung in ladder((width, 800))[:-1]}
    assert len(shared) <= 4


def test_pixels_are_almost_square():
    for width in range(600, 2000, 50):
        for w, h in ladder((width, 900))[:-1]:
            assert abs(np.log((width / 900) / (w / h))) < 0.12


def test_the_largest_rung_that_keeps_up():
    took = {RUNGS[0]: 10.0, RUNGS[1]: CLIMB * TARGET_MS - 1, RUNGS[2]: 300.0}
    assert choose(RUNGS, RUNGS, took) == RUNGS[1]
    assert choose(RUNGS, RUNGS, {rung: 5.0 for rung in RUNGS}) == RUNGS[2]
    assert choose(RUNGS, RUNGS, {rung: 900.0 for rung in RUNGS}) == RUNGS[0]


def test_a_rung_is_kept_until_another_is_clearly_better():
    between = (CLIMB + FALL) / 2 * TARGET_MS
    took = {RUNGS[0]: 10.0, RUNGS[1]: 20.0, RUNGS[2]: between}
    assert choose(RUNGS, RUNGS, took, current=RUNGS[2]) == RUNGS[2]
    assert choose(RUNGS, RUNGS, took, current=RUNGS[1]) == RUNGS[1]


def test_climbing_goes_step_by_step():
    fast = {rung: 1.0 for rung in RUNGS}
    assert choose(RUNGS, RUNGS, fast, current=RUNGS[0]) == RUNGS[1]
    assert choose(RUNGS, RUNGS, fast, current=RUNGS[1]) == RUNGS[2]
    assert choose(RUNGS, RUNGS, {rung: 900.0 for rung in RUNGS}, current=RUNGS[2]) == RUNGS[0]


def test_a_rung_that_was_slow_once_is_tried_again():
    pace = Pace()
    pace.begin({RUNGS[0]: 10.0, RUNGS[1]: 200.0})
    assert choose(RUNGS[:2], RUNGS, pace.ms, current=RUNGS[0]) == RUNGS[0]
    for _ in range(200):
        pace.took(RUNGS[0], 10.0)
    assert choose(RUNGS[:2], RUNGS, pace.ms, current=RUNGS[0]) == RUNGS[1]


def test_the_pace_follows_what_frames_take():
    pace = Pace()
    pace.begin({RUNGS[0]: 10.0})
    for _ in range(20):
        pace.took(RUNGS[0], 50.0)
    pace.begin({RUNGS[0]: 10.0})  # known better by now
    np.testing.assert_allclose(pace.ms[RUNGS[0]], 50, rtol=0.01)


def test_what_is_not_compiled_is_not_chosen():
    fast = {rung: 1.0 for rung in RUNGS}
    assert choose(RUNGS, {RUNGS[1]}, fast) == RUNGS[1]
    assert choose(RUNGS, (), fast) is None
    # Programs made for another window serve until this one's are there.
    assert choose(RUNGS, {(336, 192), (2000, 1000)}, {}) == (336, 192)


def test_at_rest_the_best_there_is():
    assert choose(RUNGS, RUNGS, {}, target_ms=np.inf) == RUNGS[2]
    assert choose(RUNGS, RUNGS[:2], {}, target_ms=np.inf) == RUNGS[1]


def test_guesses_grow_with_the_area_and_never_shrink():
    took = {(400, 200): 10.0}
    assert expected_ms((800, 400), took) == 40.0
    assert expected_ms((200, 100), took) == 10.0
    assert expected_ms((200, 100), {}) == np.inf
