"""The page in a browser, opened from disk: it renders like the package, its controls work."""

import base64
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest

from p2gs_jax import develop, load_run
from p2gs_jax.export.page import write_page
from p2gs_jax.export.page_scene import embedded_photographs

# Browsers wait more than they compute.
pytestmark = pytest.mark.slow

PATIENCE_S = 120
PHOTOGRAPHS = 3
HOSTILE = "run<img src=x onerror=hacked=1>"


@pytest.fixture(scope="module")
def fitted(finished_run, tmp_path_factory):
    """Return a run whose folder's name is hostile."""
    folder = tmp_path_factory.mktemp("hostile") / HOSTILE
    shutil.copytree(finished_run, folder)
    return load_run(folder, load_run(finished_run).scene.root)


@pytest.fixture(scope="module")
def file(fitted):
    path = fitted.folder / "scene.html"
    write_page(path, fitted, fitted.common_display(), size_mb=5, photographs=PHOTOGRAPHS)
    return path


class Opened:
    """A browser tab with the page."""

    def __init__(self, tab):
        self.tab = tab

    def __call__(self, words):
        """Return the value of a JavaScript expression of `p`, the page's `Page`."""
        return self.tab.evaluate(f"window.p2gs.then(async (p) => {words})")

    def light(self, index, *, linear=False):
        """Return RGBA of a view at its size, rows from the top; `linear`: before the exposure."""
        view = self(f"({{w: p.scene.views[{index}].width, h: p.scene.views[{index}].height}})")
        words = f"""(() => p.measure({index}, {str(linear).lower()}).then((a) => {{
            const bytes = new Uint8Array(a.buffer);
            let out = "";
            for (const b of bytes) out += String.fromCharCode(b);
            return btoa(out);
        }}))()"""
        data = np.frombuffer(base64.b64decode(self(words)), np.float32)
        return data.reshape(view["h"], view["w"], 4)

    def canvas(self):
        """Return the RGB codes of the canvas after the page has come to rest."""
        self.tab.wait_for_timeout(700)
        self("(p.draw(), 1)")
        url = self('p.renderer.canvas.toDataURL("image/png")')
        codes = np.frombuffer(base64.b64decode(url.split(",")[1]), np.uint8)
        return cv2.imdecode(codes, cv2.IMREAD_COLOR)[..., ::-1].astype(float)


@pytest.fixture
def open_page(browser, file):
    """Return a function that opens the page from disk, offline; errors and requests fail."""
    wrong, requests, contexts, expected = [], [], [], []

    def opened(link="", size=(800, 600), ratio=1):
        options = {"viewport": {"width": size[0], "height": size[1]}, "device_scale_factor": ratio}
        context = browser.new_context(**options, offline=True)
        contexts.append(context)
        tab = context.new_page()
        tab.set_default_timeout(1e3 * PATIENCE_S)
        tab.on("console", lambda m: wrong.append(m.text) if m.type == "error" else None)
        tab.on("pageerror", lambda error: wrong.append(str(error)))
        tab.on("request", lambda request: requests.append(request.url))
        tab.goto(file.as_uri() + link)
        page = Opened(tab)
        page.expect = expected.append
        page("1")
        return page

    yield opened
    for context in contexts:
        context.close()
    assert [text for text in wrong if not any(words in text for words in expected)] == []
    assert [url for url in requests if url.split(":")[0] not in ("file", "blob", "data")] == []


def decibels(a, b):
    return float(-10 * np.log10(max(np.mean((a - b) ** 2), 1e-12)))


@pytest.mark.parametrize("link", ["", "?half"])
def test_five_views_agree_with_our_renderer(open_page, fitted, link):
    page = open_page(link)
    assert page("p.renderer.half") == bool(link)
    for index in range(5):
        true = fitted.render(fitted.camera(index))
        shown, transform = page.light(index, linear=True), fitted.own_display(index)
        ours = develop(np.asarray(true.linear), transform)
        assert decibels(develop(np.ascontiguousarray(shown[..., :3]), transform), ours) > 38
        assert np.abs(shown[..., 3] - np.asarray(true.alpha)).mean() < 0.01


def test_a_camera_that_looks_straight_down_can_be_tilted_up_but_not_back(open_page):
    page = open_page()
    up = np.array(page("p.up"))
    aside = np.cross(up, np.roll(up, 1) + np.array([0.1, 0.2, 0.3]))
    aside /= np.linalg.norm(aside)
    rows = np.stack([aside, np.cross(-up, aside), -up]).ravel().tolist()
    page(f"(p.state.camera = {{...p.state.camera, R: {rows}}}, 1)")
    for key in ("ArrowUp", "ArrowDown"):
        page(f"(p.hands.held.add('{key}'), p.hands.steer(0.05), p.hands.held.clear(), 1)")
        assert -np.array(page("p.camera.R"))[6:] @ up == pytest.approx(np.cos(0.9 * 0.05))


def test_the_exposure_slider_multiplies_light_by_exactly_two_to_the_ev(open_page):
    page = open_page()
    page("p.set({ev: 0})")
    dark = page.light(1)[..., :3]
    assert (dark > 0).mean() > 0.5
    for ev in (1, 3, -2):
        page.tab.locator("#ev").fill(str(ev))
        assert page("p.state.look.ev") == ev
        np.testing.assert_array_equal(page.light(1)[..., :3], dark * np.float32(2.0**ev))
    page.tab.locator("#ev").fill("0.35")
    np.testing.assert_allclose(page.light(1)[..., :3], dark * 2**0.35, rtol=3e-7)


def test_the_picture_is_developed_as_by_the_package(open_page, fitted):
    camera, transform = fitted.camera(1), fitted.own_display(1)
    page = open_page(size=(camera.width, camera.height))
    page.tab.locator("#keep").evaluate("box => { box.checked = false; }")
    for curve in ("srgb", "power", "linear"):
        page(f'(p.go(1), p.set({{curve: "{curve}", gamma: 1.9}}))')
        linear = np.ascontiguousarray(page.light(1, linear=True)[..., :3])
        expected = 255 * develop(linear, replace(transform.with_curve(curve), gamma=1.9))
        assert np.abs(page.canvas() - expected).max() < 1.01
    # The white point keeps values to 0.18, and maps 4 (2 stops) to white.
    page('(p.go(1), p.set({curve: "linear", gamma: 2.2, white: 2, ev: 1}))')
    x = page.light(1)[..., :3].astype(float)
    shown = page.canvas() / 255
    t, w = (x - 0.18) / 0.82, (4 - 0.18) / 0.82
    expected = np.where(x <= 0.18, x, 0.18 + 0.82 * t * (1 + t / w**2) / (1 + t))
    assert np.abs(shown - np.clip(expected, 0, 1)).max() < 1.01 / 255
    assert 0.18 + 0.82 * w * (1 + 1 / w) / (1 + w) == pytest.approx(1)
    assert (x > 0.3).any()


def test_stops_and_clipping_change_the_picture(open_page):
    page = open_page()
    page("p.set({ev: 2})")
    seen = [page.canvas()]
    for mode in ("stops", "clipping"):
        page.tab.locator(f"#show-{mode}").click()
        seen.append(page.canvas())
        assert all(np.abs(seen[-1] - other).mean() > 0.5 for other in seen[:-1])
    colors = page("p.scene.stopColors")
    few = np.unique(seen[1].reshape(-1, 3), axis=0)
    assert all(np.abs(255 * np.array(colors) - c).max(1).min() < 1.01 for c in few)


def test_split_shows_the_photograph_on_the_left(open_page, fitted):
    page = open_page(size=(fitted.camera(0).width, fitted.camera(0).height))
    index = int(page("Object.keys(p.scene.photographs)[1]"))
    page(f"(p.go({index}), p.choosePhotograph())")
    page('(p.state.look.split = 0.99, p.choose("split"))')
    url = embedded_photographs(fitted, PHOTOGRAPHS)[index]
    codes = np.frombuffer(base64.b64decode(url.split(",")[1]), np.uint8)
    embedded = cv2.imdecode(codes, cv2.IMREAD_COLOR)[..., ::-1].astype(float) / 255
    shown, left = page.canvas() / 255, slice(0, int(0.9 * embedded.shape[1]))
    assert decibels(shown[:, left], embedded[:, left]) > 40
    assert decibels(embedded, fitted.photograph(index)) > 22


def test_a_lost_device_is_restored_with_the_same_picture(open_page):
    page = open_page()
    before = page.canvas()
    assert before.max() > 100
    page("(p.loss = p.renderer.gl.getExtension('WEBGL_lose_context')).loseContext()")
    page.tab.locator("#status", has_text="device was lost").wait_for()
    page("p.loss.restoreContext()")
    page.tab.locator("#status", has_text="Gaussians").wait_for()
    np.testing.assert_array_equal(page.canvas(), before)


def test_a_device_of_256_bits_a_pixel_draws_the_same(open_page):
    page = open_page()
    before = page.canvas()
    page("p.renderer.projected = p.renderer.projections([[0], [1], [2]])")
    page("(p.pose = null, p.wake())")
    np.testing.assert_array_equal(page.canvas(), before)


def test_a_failure_to_render_is_shown(open_page):
    page = open_page()
    page(
        "(p.renderer.complete = () => false, p.renderer.picture.width = 0, p.pose = null, p.wake())"
    )
    page.tab.locator("#status.wrong", has_text="cannot render").wait_for()
    page.expect("cannot render light")


def test_a_click_on_a_camera_goes_there_and_can_use_its_exposure(open_page):
    page = open_page()
    page("(p.hands.approach(0.4), p.marksShown = true, p.show())")
    page.canvas()
    mark = page("p.marks.at.find((m) => m.x > 20 && m.x < 480 && m.y > 90 && m.y < 580)")
    page.tab.mouse.click(mark["x"], mark["y"])
    at = page("p.state.at")
    assert at is not None
    assert page("p.state.look.ev") == 0  # all photographs are shown under one exposure
    page.tab.locator("#keep").evaluate("box => { box.checked = false; }")
    page(f"p.go({at})")
    assert page("p.state.look.ev") == page(f"p.scene.views[{at}].ev") != 0


def test_dragging_and_the_wheel_move_and_playing_shows_its_speed(open_page):
    page = open_page()
    here = page("p.state.camera.c")
    page.tab.mouse.move(200, 300)
    page.tab.mouse.down()
    page.tab.mouse.move(260, 320, steps=4)
    page.tab.mouse.up()
    orbited = page("p.state.camera.c")
    assert orbited != here
    page.tab.mouse.wheel(0, 200)
    page.tab.wait_for_timeout(300)
    assert page("p.state.camera.c") != orbited
    page.tab.locator("#play").click()
    page.tab.locator("#status", has_text="frames/s").wait_for()
    assert page("p.playing")


def test_a_link_restores_the_view(open_page):
    page = open_page()
    page('(p.hands.approach(1.2), p.set({ev: 1.25, gamma: 1.8, white: 1}), p.choose("stops"))')
    page.canvas()
    link, camera = page("location.hash"), page("p.state.camera")
    again = open_page(link)
    assert again("p.state.show") == "stops"
    look = again("p.state.look")
    assert (look["ev"], look["gamma"], look["white"]) == (1.25, 1.8, 1)
    for name in ("R", "c"):
        np.testing.assert_allclose(again("p.state.camera")[name], camera[name], atol=1e-5)
    # Links that make no sense are ignored.
    page = open_page("#at=1e9&ev=abc&gamma=-7&c=1,2&q=0,0,0,0&curve=__proto__&show=x&camera=99")
    assert page("p.state.look.gamma") == 0.5
    assert page("p.state.look.ev") == page("p.exported.ev")
    assert page("p.state.at") == page("p.scene.start")
    # A hostile name runs nothing.
    assert HOSTILE in page.tab.inner_text("h1")
    assert page.tab.evaluate("typeof hacked") == "undefined"
    assert page.tab.locator("img").count() == 0
