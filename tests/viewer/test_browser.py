"""The viewer in a real browser: it shows pictures, and controls change them."""

import contextlib
import os
import re
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from p2gs_jax.run.read import load_run

pytest.importorskip("viser", reason="the extra `viewer` is not installed")
# These tests take 90 s, in which they mostly wait for the browser.
pytestmark = pytest.mark.slow

SIZE = {"width": 900, "height": 640}
PATIENCE_S = 120


@pytest.fixture(scope="module")
def address(finished_run):
    from p2gs_jax.viewer.server import open_viewer

    with open_viewer(load_run(finished_run), host="127.0.0.1", port=0, max_width=640) as url:
        yield url


@pytest.fixture
def page(browser, address):
    """Return the viewer's page, at full size and at rest; it may log no error."""
    page = browser.new_page(viewport=SIZE, accept_downloads=True)
    page.set_default_timeout(1e3 * PATIENCE_S)
    wrong = []
    page.on("console", lambda m: wrong.append(m.text) if m.type == "error" else None)
    page.on("pageerror", lambda error: wrong.append(str(error)))
    page.goto(address)
    full = "/640 x \\d+/.test(document.body.innerText)"
    page.wait_for_function(f"{full} && !/compiling/.test(document.body.innerText)")
    steady(page)
    yield page
    page.close()
    assert wrong == []


def steady(page):
    """Return the picture as soon as it has stayed the same for a second."""
    end, before = time.monotonic() + PATIENCE_S, picture(page)
    while True:
        page.wait_for_timeout(1000)
        now = picture(page)
        if np.array_equal(now, before):
            return now
        assert time.monotonic() < end
        before = now


def choose(page, label, option):
    page.get_by_label(label, exact=True).click()
    page.get_by_role("option", name=option, exact=True).click()


def enter(page, label, number):
    beside = f"xpath=//label[text()='{label}']/ancestor::div[1]/following-sibling::div"
    field = page.locator(beside).locator("input[inputmode=decimal]")
    field.fill(str(number))
    field.press("Enter")


def picture(page):
    """Return the lower left part of the canvas, which no panel covers."""
    clip = {"x": 0, "y": 250, "width": 520, "height": 380}
    data = np.frombuffer(page.screenshot(clip=clip), np.uint8)
    return cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1].astype(float) / 255


def until(page, holds):
    """Return the picture as soon as `holds` is true of it twice in a row."""
    end, before = time.monotonic() + PATIENCE_S, False
    while True:
        shown = picture(page)
        now = bool(holds(shown))
        if (now and before) or time.monotonic() > end:
            assert now
            return shown
        before = now
        page.wait_for_timeout(300)


def brightening(dark, light):
    """Return the median factor between two pictures of linear values, where neither clips."""
    inside = (dark > 30 / 255) & (dark < 110 / 255) & (light < 250 / 255)
    assert inside.mean() > 0.02
    return float(np.median(light[inside] / dark[inside]))


def test_one_stop_on_the_slider_doubles_the_brightness(page):
    choose(page, "Curve", "linear")
    enter(page, "Gamma", 2.2)
    enter(page, "Exposure", 0.5)
    before = steady(page)
    enter(page, "Exposure", 1.5)
    after = until(page, lambda shown: abs(brightening(before, shown) / 2 - 1) < 0.02)
    assert after.mean() > before.mean()


def test_every_mode_shows_another_picture_and_files_can_be_saved(page):
    shown = [picture(page)]
    for mode in ("stops (false colour)", "depth", "split: photo | render"):
        choose(page, "Show", mode)
        shown.append(until(page, lambda now: all(np.abs(now - s).mean() > 2e-4 for s in shown)))
    assert page.get_by_text("depth, scene units").count() == 0
    assert page.locator("label", has_text="Split").count() == 1
    page.get_by_text("Save", exact=True).click()
    enter(page, "Width", 333)
    for button, start in (("PNG, as shown", b"\x89PNG"), ("EXR, linear light", b"v/1\x01")):
        with page.expect_download() as download:
            page.get_by_role("button", name=button).click()
        with open(download.value.path(), "rb") as file:
            content = file.read()
        assert content.startswith(start)
        if button.startswith("PNG"):
            shown = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
            assert shown.shape[1] == 333


def test_going_to_a_photograph_sets_camera_and_look_and_cameras_are_drawn(page):
    before = picture(page)
    choose(page, "Go to", "5.png")
    until(page, lambda now: np.abs(now - before).mean() > 0.01)
    assert page.get_by_label("Match photo", exact=True).input_value() == "5.png"
    before = steady(page)
    page.get_by_label("Cameras", exact=True).check()
    page.get_by_text("exposure, stops (EV) from the mean").wait_for()
    page.mouse.move(300, 500)
    page.mouse.wheel(0, 400)
    until(page, lambda now: np.abs(now - before).mean() > 0.01)


def test_the_viewer_shows_a_running_fit_and_ends_with_it(browser, finished_run, tmp_path):
    options = "--steps 100000 --gaussians 400 --test-every 3 --init.shell off --view --port 0"
    words = ["fit", finished_run.parent / "scene", "--out", tmp_path / "run", *options.split()]
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2]), "COLUMNS": "200"}
    command = [sys.executable, "-m", "p2gs_jax.cli", *words]
    fit = subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True)
    try:
        port = next(filter(None, (re.search(r"http://.+:(\d+)", line) for line in fit.stderr)))[1]
        page = browser.new_page(viewport=SIZE)
        page.set_default_timeout(1e3 * PATIENCE_S)
        page.goto(f"http://127.0.0.1:{port}")
        page.wait_for_function("/step \\d+ of 100000, loss/.test(document.body.innerText)")
        page.wait_for_function("/\\d+ ms/.test(document.body.innerText)")
        until(page, lambda shown: shown.std() > 0.05)
        page.close()
    finally:
        fit.send_signal(signal.SIGINT)
        text = fit.communicate(timeout=PATIENCE_S)[1]
    assert fit.returncode == 130, text
    end = time.monotonic() + PATIENCE_S
    with contextlib.suppress(ConnectionRefusedError):
        while time.monotonic() < end:  # it may still compile
            socket.create_connection(("127.0.0.1", int(port)), timeout=5).close()
            time.sleep(1)
        pytest.fail("the viewer goes on")
