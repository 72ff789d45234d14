"""False colour: every stop its own step, clipping where a display clips, depth by nearness."""

import numpy as np

from p2gs_jax.formats.false_color import (
    OVER,
    UNDER,
    clipping,
    clipping_overlay,
    depth_color,
    false_color,
    luminance,
    stops,
)


def grey(values):
    return np.repeat(np.asarray(values, np.float32)[None, :, None], 3, axis=-1)


def test_a_stop_is_a_factor_of_two():
    linear = grey([0.5, 1, 2, 4])
    np.testing.assert_allclose(stops(linear, middle=1.0)[0], [-1, 0, 1, 2], atol=1e-5)
    np.testing.assert_allclose(luminance(np.array([0.0, 1, 0])), 0.7152)


def test_colours_step_at_whole_stops_and_grow_lighter():
    shown = false_color(grey([1.0, 1.9, 2.1, 30]), middle=1.0)[0]
    np.testing.assert_array_equal(shown[0], shown[1])
    lightness = luminance(shown)
    assert lightness[1] < lightness[2] < lightness[3]


def test_values_beyond_the_limits_take_the_ends():
    shown = false_color(grey([0, 2.0**-20, 2.0**-5.5, 2.0**5.5, 1e30]), middle=1.0)[0]
    np.testing.assert_array_equal(shown[0], shown[1])
    np.testing.assert_array_equal(shown[1], shown[2])
    np.testing.assert_array_equal(shown[3], shown[4])


def test_clipping_follows_eight_bits():
    ldr = np.array([[[0, 0, 0], [0, 0, 0.01], [0.5, 0.5, 0.999], [1, 0.2, 0.2]]])
    over, under = clipping(ldr)
    assert over.tolist() == [[False, False, True, True]]
    assert under.tolist() == [[True, False, False, False]]


def test_overlay_stripes_only_what_is_clipped():
    ldr = np.full((24, 36, 3), 0.5, np.float32)
    ldr[:, :12], ldr[:, 24:] = 1, 0
    shown = clipping_overlay(ldr)
    np.testing.assert_array_equal(shown[:, 12:24], ldr[:, 12:24])
    for part, color, value in ((shown[:, :12], OVER, 1), (shown[:, 24:], UNDER, 0)):
        striped = np.all(np.isclose(part, color), axis=-1)
        assert 0.3 < striped.mean() < 0.7
        assert np.all(part[~striped] == value)


def test_near_is_bright_and_nothing_is_black():
    depth, alpha = np.array([[2.0, 8.0, 0.0]]), np.array([[1.0, 1.0, 0.0]])
    shown = depth_color(depth, alpha)
    assert luminance(shown)[0, 0] > luminance(shown)[0, 1] > 0
    assert not shown[0, 2].any()
    # The same surface, half covered: the expected depth counts.
    half = depth_color(depth * 0.6, alpha * 0.6)
    np.testing.assert_allclose(half, shown)
