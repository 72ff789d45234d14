"""`report --pdf`: a browser prints, and where there is none a person is told what to do."""

import os
import re

import pytest
from page_tools import copy_run

from p2gs_jax.cli import main
from p2gs_jax.errors import UserError
from p2gs_jax.report import pdf


def test_without_a_browser_the_error_says_what_was_looked_for(
    finished_run, tmp_path, monkeypatch, capsys
):
    run = copy_run(finished_run, tmp_path / "run")
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(pdf, "BROWSERS", tuple(b for b in pdf.BROWSERS if not os.path.isabs(b)))
    with pytest.raises(SystemExit) as stop:
        main(["report", str(run), "--pdf"])
    assert stop.value.code == 2
    said = capsys.readouterr().err
    assert "chromium" in said
    assert "google-chrome" in said
    assert "print it from there" in said
    assert not (run / "report.html").exists()


def test_a_browser_that_does_not_print_leaves_no_file(tmp_path):
    page, out = tmp_path / "page.html", tmp_path / "page.pdf"
    page.write_text("<p>text</p>")
    for program in ("/bin/false", str(tmp_path / "gone")):
        with pytest.raises(UserError) as error:
            pdf.print_pdf(page, out, program)
        assert "did not print" in str(error.value)
    assert list(tmp_path.iterdir()) == [page]


def test_a_page_on_paper(browser, finished_run, tmp_path):
    run = copy_run(finished_run, tmp_path / "run")
    with pytest.raises(SystemExit) as stop:
        main(["report", str(run), "--pdf", "--no-render"])
    assert stop.value.code == 0
    data = (run / "report.pdf").read_bytes()
    assert data.startswith(b"%PDF")
    assert 1 <= len(re.findall(rb"/Type\s*/Page\b", data)) <= 20
