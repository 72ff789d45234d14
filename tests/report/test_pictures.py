"""Pictures and charts: what they encode, and that they can be read."""

import base64
import re
import xml.etree.ElementTree as ElementTree

import cv2
import numpy as np
import pytest

from p2gs_jax.report.charts import RECOVERED, TRUE, ChartPanel, Series, panels_chart
from p2gs_jax.report.pictures import (
    GAIN,
    dynamic_range,
    jpeg,
    png,
    signed_difference,
    stop_picture,
    stop_shares,
)
from p2gs_jax.report.run_charts import Training, training_chart
from p2gs_jax.report.svg import VARIABLES, spread_apart
from p2gs_jax.report.view_comparisons import spread


def grey(values):
    return np.repeat(np.asarray(values, np.float32)[..., None], 3, -1)


def decoded(element):
    data = re.search(r"base64,([^\"]*)", element)[1]
    raw = np.frombuffer(base64.b64decode(data), np.uint8)
    return cv2.imdecode(raw, cv2.IMREAD_COLOR)[..., ::-1]


def test_a_difference_is_grey_where_both_agree_and_lighter_where_the_render_is_brighter():
    photograph = grey([[0.5, 0.5, 0.5, 0.5]])
    render = grey([[0.5, 0.6, 0.4, 0.5 + 1 / GAIN]])
    shown = signed_difference(render, photograph)[0, :, 0]
    np.testing.assert_allclose(shown, [0.5, 0.7, 0.3, 1.0], atol=1e-5)


def test_pictures_are_shrunk_and_survive_numbers_that_are_none():
    image = np.full((40, 1200, 3), np.nan, np.float32)
    shown = decoded(jpeg(image, "a", width=600))
    assert shown.shape == (20, 600, 3)
    assert shown.max() == 0
    assert decoded(png(grey([[2.0, -1.0]]), "a")).tolist() == [[[255] * 3, [0] * 3]]
    assert 'alt="&quot;&lt;&amp;"' in jpeg(image, '"<&')


def test_shares_of_stops():
    linear = grey([[1.5, 1.5, 3.0, 0.6, 1e6, 1e-6, 0.0, 1.0]])
    shares = {stop: share for stop, share, _ in stop_shares(linear, middle=1.0)}
    assert list(shares) == list(range(5, -7, -1))
    assert shares[0] == pytest.approx(3 / 8)
    assert shares[1] == pytest.approx(1 / 8)
    assert shares[-1] == pytest.approx(1 / 8)
    assert shares[5] == pytest.approx(1 / 8)
    assert shares[-6] == pytest.approx(2 / 8)
    assert sum(shares.values()) == pytest.approx(1)


def test_the_legend_has_the_colours_of_the_picture_and_they_grow_lighter():
    linear = grey([2.0 ** (np.arange(-6, 6) + 0.5)])
    shown = stop_picture(linear, 1.0)[0]
    legend = [color for *_, color in stop_shares(linear, 1.0)][::-1]
    np.testing.assert_allclose(shown, legend, atol=1e-6)
    assert np.all(np.diff(shown @ [0.2126, 0.7152, 0.0722]) > 0)


def test_dynamic_range():
    values = np.repeat(2.0 ** np.arange(0, 8.0), 100).reshape(8, 100)
    assert dynamic_range(grey(values)) == pytest.approx(7.0, abs=0.01)
    assert dynamic_range(np.zeros((4, 4, 3))) == 0.0


def test_spread_takes_both_ends():
    assert spread([1, 2, 3], 5) == [1, 2, 3]
    assert spread(list(range(11)), 3) == [0, 5, 10]


def test_labels_keep_their_distance_and_stay_near_their_curves():
    assert spread_apart([0, 50, 100], 15) == [0, 50, 100]
    assert spread_apart([10, 10, 10], 15) == [-5, 10, 25]
    places = spread_apart([0, 8, 12, 60], 15)
    assert np.all(np.diff(places) >= 15 - 1e-9)
    assert places[3] == 60


def chart_of(error=None, second=None):
    x = np.arange(1.0, 7.0)
    series = [Series("found", x, np.sin(x), RECOVERED, error)]
    if second is not None:
        series.append(Series("true", x, second, TRUE))
    return panels_chart([ChartPanel("a", tuple(series))], y_label="y", x_label="x", label="l")


def test_error_bars_are_drawn():
    # Two caps at each of six values, wide and narrow.
    assert chart_of(np.full(6, 0.2)).count("<use") == chart_of().count("<use") + 24


def test_missing_values_break_the_line():
    values = np.array([0.0, 1, np.nan, 1, 0, np.nan])
    line = re.findall(r'd="([^"]*)"[^>]*stroke-dasharray', chart_of(second=values))
    assert any(path.count("M") == 2 for path in line)


def test_charts_are_drawn_twice_in_the_page_s_colours():
    text = chart_of(second=np.zeros(6))
    assert text.count('role="img" aria-label="l"') == 2
    assert not any(placeholder in text for placeholder in VARIABLES)
    assert "var(--first)" in text
    for svg in re.findall(r"<svg.*?</svg>", text, flags=re.DOTALL):
        tree = ElementTree.fromstring(svg.replace("xlink:href", "href"))
        words = ["".join(t.itertext()) for t in tree.iter("text")]
        assert {"found", "true", "a", "x", "y"} <= set(words)


def test_what_changes_in_a_run_is_marked():
    steps = np.arange(0.0, 1000, 10)

    def draw(marks):
        training = Training(steps, 20 + steps / 100, {"loss": 1 / (1 + steps)}, steps + 5, marks)
        return training_chart(training, label="l")

    marked = draw(((500.0, "full-size images"),))
    assert "full-size images" in marked
    # A line in each of three panels, wide and narrow.
    assert marked.count("stroke-dasharray") == draw(()).count("stroke-dasharray") + 6
