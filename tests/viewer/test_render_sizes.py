"""Which sizes exist, and which of them the next frame takes."""

import numpy as np

from p2gs_jax.viewer.render_sizes import (
    ENLARGE_WITHIN,
    SHRINK_BEYOND,
    TARGET_MS,
    FrameTimes,
    choose_size,
    compilation_order,
    expected_ms,
    full_size,
    render_sizes,
)

SIZES = ((320, 200), (480, 300), (1280, 800))


def test_the_canvas_itself_up_to_a_width():
    assert full_size((1280, 800), 1920) == (1280, 800)
    assert full_size((3840, 2160), 1920) == (1920, 1080)
    assert full_size((0, 0), 1920) == (1, 1)


def test_sizes_rise_to_the_full_size():
    for canvas in ((1280, 800), (1920, 950), (600, 1000), (200, 150), (1, 1)):
        sizes = render_sizes(canvas)
        areas = [w * h for w, h in sizes]
        assert areas == sorted(set(areas))
        assert sizes[-1] == canvas
        assert set(compilation_order(sizes)) == set(sizes)
        assert all(w % 8 == h % 8 == 0 for w, h in sizes[:-1])


def test_windows_of_nearly_the_same_shape_share_programs():
    shared = {size for width in range(1250, 1350) for size in render_sizes((width, 800))[:-1]}
    assert len(shared) <= 4


def test_pixels_are_almost_square():
    for width in range(600, 2000, 50):
        for w, h in render_sizes((width, 900))[:-1]:
            assert abs(np.log((width / 900) / (w / h))) < 0.12


def test_the_largest_size_that_keeps_up():
    took = {SIZES[0]: 10.0, SIZES[1]: ENLARGE_WITHIN * TARGET_MS - 1, SIZES[2]: 300.0}
    assert choose_size(SIZES, SIZES, took) == SIZES[1]
    assert choose_size(SIZES, SIZES, {size: 5.0 for size in SIZES}) == SIZES[2]
    assert choose_size(SIZES, SIZES, {size: 900.0 for size in SIZES}) == SIZES[0]


def test_a_size_is_kept_until_another_is_clearly_better():
    between = (ENLARGE_WITHIN + SHRINK_BEYOND) / 2 * TARGET_MS
    took = {SIZES[0]: 10.0, SIZES[1]: 20.0, SIZES[2]: between}
    assert choose_size(SIZES, SIZES, took, current=SIZES[2]) == SIZES[2]
    assert choose_size(SIZES, SIZES, took, current=SIZES[1]) == SIZES[1]


def test_climbing_goes_step_by_step():
    fast = {size: 1.0 for size in SIZES}
    assert choose_size(SIZES, SIZES, fast, current=SIZES[0]) == SIZES[1]
    assert choose_size(SIZES, SIZES, fast, current=SIZES[1]) == SIZES[2]
    assert choose_size(SIZES, SIZES, {size: 900.0 for size in SIZES}, current=SIZES[2]) == SIZES[0]


def test_a_size_that_was_slow_once_is_tried_again():
    times = FrameTimes()
    times.add_known({SIZES[0]: 10.0, SIZES[1]: 200.0})
    assert choose_size(SIZES[:2], SIZES, times.ms, current=SIZES[0]) == SIZES[0]
    for _ in range(200):
        times.update(SIZES[0], 10.0)
    assert choose_size(SIZES[:2], SIZES, times.ms, current=SIZES[0]) == SIZES[1]


def test_the_pace_follows_what_frames_take():
    times = FrameTimes()
    times.add_known({SIZES[0]: 10.0})
    for _ in range(20):
        times.update(SIZES[0], 50.0)
    times.add_known({SIZES[0]: 10.0})  # known better by now
    np.testing.assert_allclose(times.ms[SIZES[0]], 50, rtol=0.01)


def test_what_is_not_compiled_is_not_chosen():
    fast = {size: 1.0 for size in SIZES}
    assert choose_size(SIZES, {SIZES[1]}, fast) == SIZES[1]
    assert choose_size(SIZES, (), fast) is None
    # Programs made for another window serve until this one's are there.
    assert choose_size(SIZES, {(336, 192), (2000, 1000)}, {}) == (336, 192)


def test_at_rest_the_best_there_is():
    assert choose_size(SIZES, SIZES, {}, target_ms=np.inf) == SIZES[2]
    assert choose_size(SIZES, SIZES[:2], {}, target_ms=np.inf) == SIZES[1]


def test_guesses_grow_with_the_area_and_never_shrink():
    took = {(400, 200): 10.0}
    assert expected_ms((800, 400), took) == 40.0
    assert expected_ms((200, 100), took) == 10.0
    assert expected_ms((200, 100), {}) == np.inf
