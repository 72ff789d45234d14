"""A real page of the viewer, in a headless browser."""

from __future__ import annotations

import shutil
import time

CHROMIUM = ("chromium", "chromium-browser", "google-chrome")
WIDTH, HEIGHT = 480, 320
EVERY_S = 0.25
# viser's splats are drawn with corners in two dimensions, which three.js remarks on once.
VISERS_OWN = "computeBoundingSphere(): Computed radius is NaN"


def chromium() -> str | None:
    """Return where Chromium lies, or None without it or playwright."""
    try:
        import playwright  # noqa: F401
    except ImportError:
        return None
    return next(filter(None, map(shutil.which, CHROMIUM)), None)


async def look(path: str, address: str, seconds: float) -> tuple[int, list[str]]:
    """Open the page and drag over it for some seconds.

    Args:
        path: of Chromium.
        address: of the viewer.
        seconds: to look for.

    Returns:
        How many messages came, and the errors that the page reported.
    """
    from playwright.async_api import async_playwright

    came, wrong = 0, []

    def received(_: object) -> None:
        nonlocal came
        came += 1

    async with async_playwright() as playwright:
        # Its WebGL needs the software rasterizer where there is no GPU.
        args = ["--no-sandbox", "--enable-unsafe-swiftshader"]
        browser = await playwright.chromium.launch(executable_path=path, args=args)
        page = await browser.new_page(viewport={"width": WIDTH, "height": HEIGHT})
        page.set_default_timeout(120e3)
        page.on("websocket", lambda socket: socket.on("framereceived", received))
        page.on("console", lambda m: wrong.append(m.text) if m.type == "error" else None)
        page.on("pageerror", lambda error: wrong.append(str(error)))
        end = time.monotonic() + seconds
        await page.goto(address)
        # At rest first: that is when it asks for programs of its size.
        await page.wait_for_timeout(min(3e3, 250 * seconds))
        await page.mouse.move(100, 160)
        await page.mouse.down()
        step = 0
        while time.monotonic() < end:
            await page.mouse.move(80 + 40 * (step % 3), 160)
            await page.wait_for_timeout(1e3 * EVERY_S)
            step += 1
        await browser.close()
    return came, [text for text in wrong if VISERS_OWN not in text]
