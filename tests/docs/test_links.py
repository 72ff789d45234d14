"""Every link inside the documentation leads somewhere, and every page is led to."""

import pytest
from pages import PAGES, ROOT, anchors, links

NAMES = [str(p.relative_to(ROOT)) for p in PAGES]


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
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
