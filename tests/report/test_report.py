"""`p2gs-jax report`: one self-contained page, also for runs with missing or broken files."""

import itertools
import re

import cv2
import numpy as np
import pytest
from page_tools import (
    HOSTILE,
    Markup,
    check_in_a_browser,
    copy_run,
    edit,
    headings,
    pictures,
    words_of,
)

from p2gs_jax.evaluation.seams import Seam, SeamPicture
from p2gs_jax.report.measurements import SceneMeasurements
from p2gs_jax.report.report import report_page, write_report
from p2gs_jax.report.run_files import read_run

HEADINGS = [
    *("Warnings", "Photometric model", "Exposures", "Tone curve"),
    *("Seams between photographs", "Held-out views", "Scores", "Training", "Configuration"),
]


@pytest.fixture(scope="module")
def run(finished_run, tmp_path_factory):
    return copy_run(finished_run, tmp_path_factory.mktemp("reported") / "run")


@pytest.fixture(scope="module")
def page(run):
    return write_report(run).read_text()


@pytest.fixture(scope="module")
def full_page(run, tmp_path_factory):
    """Return a page with all elements, also those for which the small run has too little data."""
    files = read_run(run)
    files.photometry["model"] = "view_exposure_gamma"
    for i, view in enumerate(files.views):
        view.update(camera="front" if i % 2 else "rear")
        view["exif_ev"] = (view["exposure_ev"] or 0) - 7 + (0.5 if i == 1 else 0)
        if view["split"] == "train":
            view.update(gamma=2.0 + 0.1 * i, gamma_error=0.02, exposure_ev_error=0.04)
    files.log[:] = [
        files.log[0]
        | {"step": 10 * i, "progress": i / 100, "shrink": 4 if i < 25 else 2 if i < 50 else 1}
        for i in range(1, 101)
    ]
    names = [v["image"] for v in files.train]
    seam = Seam(1.25, 0.07, 40.0, 2.5, 0.01, 900)
    seams = dict.fromkeys(itertools.pairwise(names), seam)
    dark, light = np.full((40, 60, 3), 0.25, np.float32), np.full((40, 60, 3), 0.75, np.float32)
    scene = SceneMeasurements(
        true_exposures={v["image"]: 3 * (v["exposure"] or 1) for v in files.views},
        seams=seams,
        tried_pairs=len(seams),
        shown=next(iter(seams)),
        picture=SeamPicture(dark, light, left_first=False),
    )
    path = tmp_path_factory.mktemp("full") / "report.html"
    path.write_text(report_page(files, scene), encoding="utf-8")
    return path


def test_every_section_has_the_values_of_the_run_and_the_page_fetches_nothing(page, run):
    assert headings(page) == HEADINGS
    links = re.findall(r"""(?:src|href)\s*=\s*["']?([^"'\s>]*)""", page)
    assert len(links) > 20
    assert all(link.startswith(("data:", "#")) for link in links)
    assert "url(" not in page.replace("url(#", "")
    assert "<script" not in page
    assert len(page) < 3e6
    text, files = words_of(page), read_run(run)
    assert f"{files.number('test', 'exposure_fitted', 'psnr'):.1f} dB" in text
    assert f"{files.number('train', 'psnr'):.2f}" in text
    assert f"{int(files.number('counts', 'gaussians')):,}" in text
    assert "Model kept:" in text
    assert all(note in text for note in files.metrics["notes"])
    assert all(view["image"] in text for view in files.views)
    assert "train.steps 60 2000" in text


def test_pictures_on_the_page_agree_with_the_files_of_the_run(page, run):
    shown, held_out = pictures(page), read_run(run).held_out
    assert len(held_out) == 2
    for files in held_out:
        want, got = cv2.imread(str(files.photograph)), shown[f"Photograph {files.name}"]
        assert got.shape == want.shape
        # JPEG keeps brightness better than colour.
        grey = [cv2.cvtColor(image, cv2.COLOR_BGR2GRAY).astype(float) for image in (got, want)]
        assert np.mean(np.abs(grey[0] - grey[1])) < 4
        assert np.ptp(shown[f"Difference at {files.name}"].astype(int), axis=-1).max() <= 2  # grey


@pytest.mark.parametrize("width", [300, 760, 1600])
def test_the_page_fits_into_a_browser_of_any_width(browser, full_page, width):
    found = check_in_a_browser(browser, full_page, width)
    assert found["headings"] == HEADINGS
    assert len(found["images"]) >= 8


def test_seams_are_shown_with_their_numbers(full_page, run):
    text = full_page.read_text()
    first, second = (v["image"].removesuffix(".png") for v in read_run(run).train[:2])
    assert "differs by 1.25 stops as recorded, and by 0.07 stops after" in words_of(text)
    assert f"Left half: {second}. Right half: {first}." in words_of(text)
    assert "As recorded: a difference of 1.25 stops, or 40 8-bit levels" in words_of(text)
    for kind, level in (("as recorded", 64), ("at one exposure", 191)):
        picture = pictures(text)[f"{second} beside {first}, {kind}"]
        assert np.median(picture) == pytest.approx(level, abs=1)


def test_without_rendering_or_the_scene_all_sections_are_there(run, tmp_path):
    text = write_report(run, tmp_path / "quick.html", render=False).read_text()
    assert headings(text) == HEADINGS
    assert "without rendering" in words_of(text)
    moved = copy_run(run, tmp_path / "run")
    edit(moved / "config.json", lambda c: c.update(scene=str(tmp_path / "gone")))
    text = write_report(moved).read_text()
    assert headings(text) == HEADINGS
    assert f"{tmp_path / 'gone'}, does not exist" in words_of(text)


@pytest.mark.parametrize("lost", ["metrics.json", "photometry.json", "log.jsonl", "radiance.ply"])
def test_missing_files_are_reported_and_not_fatal(run, tmp_path, lost):
    poor = copy_run(run, tmp_path / "run")
    (poor / lost).unlink()
    page = write_report(poor, render=lost == "radiance.ply")
    assert f"{lost} is missing" in words_of(page.read_text())


@pytest.mark.parametrize("names", ["config.json", "metrics.json photometry.json log.jsonl"])
@pytest.mark.parametrize("content", ["{", "[]", '{"train": null, "test": []}', "\x00\xff"])
def test_broken_files_do_not_break_the_page(run, tmp_path, names, content):
    broken = copy_run(run, tmp_path / "run")
    for name in names.split():
        (broken / name).write_text(content, encoding="latin-1")
    text = write_report(broken, render=False).read_text()
    assert "Missing parts of this page" in text or content.startswith('{"train"')


def test_the_command_reports_broken_files_and_missing_ones(run, tmp_path, run_command):
    broken = copy_run(run, tmp_path / "run")
    (broken / "photometry.json").write_text("{")
    for expected in (1, 0):
        code, printed = run_command("report", broken, "--no-render")
        assert code == expected
        assert "photometry.json" in printed.replace("\n", "")
        (broken / "photometry.json").unlink(missing_ok=True)


def test_names_are_text_never_markup(run, page, tmp_path):
    odd = copy_run(run, tmp_path / "run")

    def views(photometry):
        for view in photometry["views"][1:3]:
            view.update(image=HOSTILE + view["image"], camera=HOSTILE)
        photometry["gauge"] = HOSTILE

    edit(odd / "photometry.json", views)
    edit(odd / "metrics.json", lambda m: m.update(notes=[HOSTILE], split=HOSTILE))
    edit(odd / "config.json", lambda c: c.update(scene=f"/gone/{HOSTILE}"))
    edit(odd / "config.json", lambda c: c["fit"].update(preset=HOSTILE))
    text = write_report(odd, render=False).read_text()
    found, plain = Markup(text), Markup(page)
    # A second camera brings a second panel, and no element of another kind.
    assert found.elements <= plain.elements
    assert all(target.startswith(("data:", "#")) for target in found.targets)
    assert "<img src=x" not in text
    assert text.count("onerror=alert(1)") == text.count("onerror=alert(1)&gt;") > 5
    assert not set("\x1b\u202e") & set(text)


def test_all_values_of_a_run_are_drawn(full_page):
    text = words_of(full_page.read_text())
    assert all(f" {label} " in text for label in ("recovered", "held-out view", "EXIF", "true"))
    for words in (
        *("RMS error 0.000 stops", "Crosses are EXIF", "EXIF disagrees with the pixels"),
        *("two standard errors, at most ±0.08 stops", "camera front", "camera rear"),
        *("gamma 2.10", "gamma 2.50"),
        *("images at 1/2 from step 250", "full-size images from step 500"),
    ):
        assert words in text
    assert "all photographs" not in text


@pytest.mark.parametrize("name", ["page.pdf", "page", "folder.html", "file/page.html"])
def test_paths_that_cannot_hold_a_page_are_refused(run, tmp_path, refused, name):
    (tmp_path / "folder.html").mkdir()
    (tmp_path / "file").write_text("")
    printed = refused("report", run, "--no-render", "--out", tmp_path / name)
    assert name in printed.replace("\n", "")
    assert "config.json is missing" in refused("report", tmp_path)
    assert "nosuch does not exist" in refused("report", run, "--scene", "nosuch", "--out", "x.html")
