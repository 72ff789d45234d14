"""Every link inside the documentation leads somewhere, and every page is led to."""

import pytest
from pages import PAGES, ROOT, anchors, links

LINKED = [*PAGES, ROOT / "BUILD_NOTES.md", *sorted((ROOT / "experiments").rglob("*.md"))]


@pytest.mark.parametrize("page", LINKED, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_resolve(page):
    for target in links(page):
        path, _, anchor = target.partition("#")
        found = (page.parent / path).resolve() if path else page
        assert found.exists(), f"{page.name} links to {target}, which is not there"
        if anchor:
            assert anchor in anchors(found), f"{found.name} has no heading for #{anchor}"


@pytest.mark.parametrize("folder", ["docs", "experiments/results"])
def test_the_index_leads_to_every_page(folder):
    index = ROOT / folder / "README.md"
    reached = {(index.parent / target.partition("#")[0]).resolve() for target in links(index)}
    missing = set((ROOT / folder).rglob("*.md")) - reached - {index}
    assert not missing, f"{index} does not lead to them"
