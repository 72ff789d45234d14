"""Tools for tests of pages: copies of run folders, the contents of pages, checks in a browser."""

import base64
import html
import html.parser
import json
import re
import shutil
from pathlib import Path

import cv2
import numpy as np

LOOK = """() => ({
    content: document.documentElement.scrollWidth,
    window: innerWidth,
    images: [...document.images].map(i => [i.complete, i.naturalWidth, i.alt]),
    headings: [...document.querySelectorAll('h2')].map(h => h.textContent),
    anchors: [...document.querySelectorAll('nav a')].map(
        a => document.querySelector(a.getAttribute('href')) !== null),
    smallest: Math.min(...[...document.querySelectorAll('svg text')]
        .map(t => [parseFloat(getComputedStyle(t).fontSize), t.getScreenCTM()])
        .map(([size, m]) => size * Math.hypot(m.a, m.b))),
    ids: [...document.querySelectorAll('[id]')].map(e => e.id),
    spilled: [...document.querySelectorAll('svg text')]
        .map(t => [t.textContent, ...[t, t.closest('svg')].map(e => e.getBoundingClientRect())])
        .filter(([_, r, s]) => r.left < s.left - 2 || r.right > s.right + 2)
        .map(([text]) => text),
})"""


def copy_run(source: Path, target: Path) -> Path:
    return shutil.copytree(source, target, ignore=shutil.ignore_patterns("checkpoints", "*.html"))


def edit(path: Path, change) -> None:
    value = json.loads(path.read_text())
    change(value)
    path.write_text(json.dumps(value))


HOSTILE = '"><img src="http://x/" onerror=alert(1)>|`*[a](javascript:1)</style>&$a${{css}}'
HOSTILE += "\x1b\u202e\udcff.png"


class Markup(html.parser.HTMLParser):
    """The elements of a page with the names of their attributes, and the targets of its links."""

    def __init__(self, text):
        super().__init__()
        self.elements, self.targets = set(), []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.elements.add((tag, *sorted(name for name, _ in attrs)))
        self.targets += [value for name, value in attrs if name in ("src", "href", "xlink:href")]


def headings(text: str) -> list[str]:
    return [html.unescape(h) for h in re.findall(r"<h2>(.*?)</h2>", text)]


def words_of(text: str) -> str:
    return " ".join(html.unescape(re.sub(r"<[^>]*>", " ", text)).split())


def pictures(text: str) -> dict[str, np.ndarray]:
    """Return decoded pictures of a page by their alt texts."""
    found = {}
    for data, alt in re.findall(r'src="data:image/\w+;base64,([^"]*)"[^>]*alt="([^"]*)"', text):
        raw = np.frombuffer(base64.b64decode(data), np.uint8)
        found[html.unescape(alt)] = cv2.imdecode(raw, cv2.IMREAD_COLOR)
    return found


def check_in_a_browser(browser, path: Path, width: int) -> dict:
    """Open a page, check that it fits, fetches nothing and reports nothing; return its parts."""
    page = browser.new_page(viewport={"width": width, "height": 900})
    fetched, messages = [], []
    page.on("request", lambda request: fetched.append(request.url))
    page.on("console", lambda message: messages.append(message.text))
    page.on("pageerror", lambda error: messages.append(str(error)))
    page.goto(path.as_uri())
    page.wait_for_load_state("load")
    found = page.evaluate(LOOK)
    page.close()
    assert [url for url in fetched if not url.startswith("data:")] == [path.as_uri()]
    assert messages == []
    assert found["content"] <= found["window"] == width
    assert found["smallest"] >= 9
    assert found["spilled"] == []
    assert all(complete and natural > 0 and alt for complete, natural, alt in found["images"])
    assert all(found["anchors"])
    assert len(found["ids"]) == len(set(found["ids"]))
    return found
