"""Every link inside the documentation leads somewhere, and every page is led to."""

import re

import pytest
from pages import PAGES, ROOT, anchors, links

LAB_BOOK, RESULTS = ROOT / "BUILD_NOTES.md", ROOT / "experiments" / "results"
LINKED = [*PAGES, LAB_BOOK, *sorted((ROOT / "experiments").rglob("*.md"))]
NAMES = [str(p.relative_to(ROOT)) for p in LINKED]


@pytest.mark.parametrize("page", LINKED, ids=NAMES)
def test_links_resolve(page):
    for target in links(page):
        path, _, anchor = target.partition("#")
        found = (page.parent / path).resolve() if path else page
        assert found.exists(), f"{page.name} links to {target}, which is not there"
        if anchor:
            assert anchor in anchors(found), f"{found.name} has no heading for #{anchor}"


def test_the_index_leads_to_every_page():
    index = ROOT / "docs" / "README.md"
    reached = {(index.parent / target.partition("#")[0]).resolve() for target in links(index)}
    for page in (ROOT / "docs").rglob("*.md"):
        assert page == index or page in reached, f"docs/README.md does not lead to {page.name}"


def test_the_index_of_results_leads_to_every_record():
    index = RESULTS / "README.md"
    reached = {(RESULTS / target.partition("#")[0]).resolve() for target in links(index)}
    for page in RESULTS.glob("*.md"):
        assert page == index or page in reached, f"{index} does not lead to {page.name}"


def test_the_lab_book_has_what_code_and_pages_refer_to():
    text = LAB_BOOK.read_text(encoding="utf-8")
    titles = set(re.findall(r"^#+ (.*)$|\*\*(.+?)\*\*", re.sub(r"\n  +", " ", text), flags=re.M))
    names = {heading or bold for heading, bold in titles}
    sources = [*(ROOT / "p2gs_jax").rglob("*.py"), *PAGES]
    found = 0
    for source in sources:
        words = re.sub(r"\s*\n\s*(# )?", " ", source.read_text(encoding="utf-8"))
        for name in re.findall(r'BUILD_NOTES, "([^"]+)"', words):
            found += 1
            assert name in names, f"{source.name}: BUILD_NOTES has no {name!r}"
    assert found >= 20
