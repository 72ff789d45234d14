"""Pages of tests: a run folder to change, and what a browser says of a page."""

import json
import shutil
from pathlib import Path


def copy_run(source: Path, target: Path) -> Path:
    """Copy a run without what the tests never read."""
    return shutil.copytree(source, target, ignore=shutil.ignore_patterns("checkpoints", "*.html"))


def edit(path: Path, change) -> None:
    """Change a JSON file in place."""
    value = json.loads(path.read_text())
    change(value)
    path.write_text(json.dumps(value))


def look_at(browser, path: Path, width: int) -> dict:
    """Open a page and return what it fetched, said and measured."""
    page = browser.new_page(viewport={"width": width, "height": 900})
    fetched, said = [], []
    page.on("request", lambda request: fetched.append(request.url))
    page.on("console", lambda message: said.append(message.text))
    page.on("pageerror", lambda error: said.append(str(error)))
    page.goto(path.as_uri())
    page.wait_for_load_state("load")
    found = page.evaluate(
        """() => ({
            content: document.documentElement.scrollWidth,
            window: innerWidth,
            images: [...document.images].map(i => [i.complete, i.naturalWidth, i.alt]),
            headings: [...document.querySelectorAll('h2')].map(h => h.textContent),
            anchors: [...document.querySelectorAll('nav a')].map(
                a => document.querySelector(a.getAttribute('href')) !== null),
            smallest: Math.min(...[...document.querySelectorAll('svg text')]
                .filter(t => t.getBoundingClientRect().height > 0)
                .map(t => [parseFloat(getComputedStyle(t).fontSize), t.getScreenCTM()])
                .map(([size, m]) => size * Math.hypot(m.a, m.b))),
            ids: [...document.querySelectorAll('[id]')].map(e => e.id),
            spilled: [...document.querySelectorAll('svg text')]
                .map(t => [t.textContent, t.getBoundingClientRect()])
                .filter(([_, r]) => r.width > 0 && (r.left < 0 || r.right > innerWidth))
                .map(([text]) => text),
        })"""
    )
    page.close()
    found["fetched"] = [url for url in fetched if not url.startswith("data:")]
    found["said"] = said
    return found
