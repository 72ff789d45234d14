"""`p2gs-jax report`: everything on one page that needs nothing else, whatever the run lacks."""

import base64
import html
import itertools
import re
import shutil

import cv2
import numpy as np
import pytest
from page_tools import copy_run, edit, look_at

from p2gs_jax.cli import main
from p2gs_jax.evaluate.seam_picture import SeamPicture
from p2gs_jax.evaluate.seams import Seam
from p2gs_jax.report.report import report_page, write_report
from p2gs_jax.report.run_files import read_run
from p2gs_jax.report.scene_measurements import SceneMeasurements, SeamPair

HEADINGS = [
    *("What to watch", "What was modelled, and why", "Exposures", "Gamma", "Tone curve"),
    *("Seams before and after", "Held-out views", "Radiance in stops", "Scores", "Training"),
    *("Timings and counts", "Configuration"),
]


@pytest.fixture(scope="module")
def run(finished_run, tmp_path_factory):
    return copy_run(finished_run, tmp_path_factory.mktemp("reported") / "run")


@pytest.fixture(scope="module")
def page(run):
    with pytest.raises(SystemExit) as stop:
        main(["report", str(run)])
    assert stop.value.code == 0
    return run / "report.html"


@pytest.fixture(scope="module")
def full_page(run, tmp_path_factory):
    """A page with everything that a run can show, also what the small one has too little for."""
    files = read_run(run)
    files.photometry["model"] = "view_exposure_gamma"
    for i, view in enumerate(files.views):
        view.update(camera="front" if i % 2 else "rear", exif_ev=-7.0 + i / 3)
        if view["split"] == "train":
            view.update(gamma=2.0 + 0.1 * i, gamma_error=0.02, exposure_ev_error=0.04)
    path = tmp_path_factory.mktemp("full") / "report.html"
    path.write_text(report_page(files, full_scene(files)), encoding="utf-8")
    return path


def full_scene(files):
    names = [v["image"] for v in files.train]
    pairs = tuple(
        SeamPair(a, b, Seam(1.25, 0.07, 40.0, 2.5, 0.01, 900)) for a, b in itertools.pairwise(names)
    )
    dark, light = np.full((40, 60, 3), 0.25, np.float32), np.full((40, 60, 3), 0.75, np.float32)
    return SceneMeasurements(
        true_exposures={v["image"]: 1.0 + i / 4 for i, v in enumerate(files.views)},
        seams=pairs,
        tried_pairs=len(pairs),
        shown=pairs[0],
        picture=SeamPicture(dark, light, left_first=False),
        clipped={names[0]: 0.5},
    )


def headings(text):
    return [html.unescape(h) for h in re.findall(r"<h2>(.*?)</h2>", text)]


def words_of(text):
    """The text of a page."""
    return " ".join(html.unescape(re.sub(r"<[^>]*>", " ", text)).split())


def pictures(text):
    """Decoded pictures of a page by their alt texts."""
    found = {}
    for data, alt in re.findall(r'src="data:image/\w+;base64,([^"]*)"[^>]*alt="([^"]*)"', text):
        raw = np.frombuffer(base64.b64decode(data), np.uint8)
        found[html.unescape(alt)] = cv2.imdecode(raw, cv2.IMREAD_COLOR)
    return found


def test_every_section_is_there_and_nothing_is_fetched(page):
    text = page.read_text()
    assert headings(text) == HEADINGS
    links = re.findall(r"""(?:src|href)\s*=\s*["']?([^"'\s>]*)""", text)
    assert len(links) > 20
    assert all(link.startswith(("data:", "#")) for link in links)
    assert "url(" not in text.replace("url(#", "")
    assert "<script" not in text
    assert page.stat().st_size < 3e6


def test_the_page_says_what_the_run_says(page, run):
    text = words_of(page.read_text())
    files = read_run(run)
    held_out = f"2 more were held out: {files.metrics['split']}"
    assert f"4 photographs of scene by 1 camera ({held_out}) were fitted" in text
    assert f"{files.number('test', 'exposure_fitted', 'psnr'):.1f} dB" in text
    assert f"{files.number('train', 'psnr'):.2f}" in text
    assert f"{int(files.number('counts', 'gaussians')):,}" in text
    assert "Chosen:" in text
    for note in files.metrics["notes"]:
        assert note in text
    for view in files.views:
        assert view["image"] in text
    assert "train.steps 60 2000" in text


def test_pictures_are_the_run_s(page, run):
    shown = pictures(page.read_text())
    held_out = read_run(run).held_out
    assert len(held_out) == 2
    for files in held_out:
        want = cv2.imread(str(files.photograph))
        got = shown[f"Photograph {files.name}"]
        assert got.shape == want.shape
        # JPEG keeps brightness better than colour.
        grey = [cv2.cvtColor(image, cv2.COLOR_BGR2GRAY).astype(float) for image in (got, want)]
        assert np.mean(np.abs(grey[0] - grey[1])) < 4
        difference = shown[f"Difference at {files.name}"]
        assert np.ptp(difference.astype(int), axis=-1).max() <= 2  # grey
    assert any(alt.endswith("in stops") for alt in shown)


@pytest.mark.parametrize("width", [300, 700, 760, 1600])
def test_in_a_browser(browser, full_page, width):
    found = look_at(browser, full_page, width)
    assert found["fetched"] == [full_page.as_uri()]
    assert found["said"] == []
    assert found["content"] <= found["window"] == width
    assert found["headings"] == HEADINGS
    assert len(found["images"]) >= 9
    assert all(complete and natural > 0 and alt for complete, natural, alt in found["images"])
    assert all(found["anchors"])
    assert found["smallest"] >= 9
    assert found["spilled"] == []
    assert len(found["ids"]) == len(set(found["ids"]))


def test_seams_are_shown_with_their_numbers(full_page, run):
    text = full_page.read_text()
    first, second = (v["image"].removesuffix(".png") for v in read_run(run).train[:2])
    said = words_of(text)
    assert "differ by 1.25 stops as taken, and by 0.07 once" in said
    assert f"Left half: {second}. Right half: {first}." in said
    assert "As taken: 1.25 stops, 40 8-bit levels apart" in said
    shown = pictures(text)
    assert np.median(shown[f"{second} beside {first}, as taken"]) == pytest.approx(64, abs=1)
    assert np.median(shown[f"{second} beside {first}, developed alike"]) == pytest.approx(
        191, abs=1
    )


def test_without_rendering_the_rest_is_there(run, tmp_path):
    text = write_report(run, tmp_path / "quick.html", render=False).read_text()
    assert headings(text) == HEADINGS
    assert "without rendering" in words_of(text)


def test_a_scene_that_has_moved_is_said(run, tmp_path):
    moved = copy_run(run, tmp_path / "run")
    edit(moved / "config.json", lambda c: c.update(scene=str(tmp_path / "gone")))
    text = write_report(moved).read_text()
    assert headings(text) == HEADINGS
    assert f"{tmp_path / 'gone'}, is not there" in words_of(text)


@pytest.mark.parametrize(
    ("lost", "said"),
    [
        ("metrics.json", "metrics.json is missing"),
        ("photometry.json", "photometry.json is missing"),
        ("log.jsonl", "log.jsonl is missing"),
        ("renders", "Configuration"),
        ("radiance.ply", "radiance.ply is missing"),
    ],
)
def test_what_is_missing_is_said_and_not_fatal(run, tmp_path, lost, said):
    poor = copy_run(run, tmp_path / "run")
    path = poor / lost
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    assert said in words_of(write_report(poor).read_text())


def test_without_held_out_files_training_views_are_rendered(run, tmp_path):
    poor = copy_run(run, tmp_path / "run")
    shutil.rmtree(poor / "renders")
    text = write_report(poor).read_text()
    assert "Training views" in headings(text)
    assert "Radiance in stops" in headings(text)
    trained = [v["image"] for v in read_run(run).train]
    assert any(f"Render of {name}" in pictures(text) for name in trained)


@pytest.mark.parametrize("name", ["metrics.json", "photometry.json", "log.jsonl", "config.json"])
@pytest.mark.parametrize("content", ["{", "[]", "null", '{"train": null, "test": []}', "\x00\xff"])
def test_broken_files_do_not_break_the_page(run, tmp_path, name, content):
    broken = copy_run(run, tmp_path / "run")
    (broken / name).write_text(content, encoding="latin-1")
    text = write_report(broken, render=False).read_text()
    assert "What this page lacks" in text or content.startswith('{"train"')


def test_broken_files_are_said_by_the_command(run, tmp_path, capsys):
    broken = copy_run(run, tmp_path / "run")
    for content, code in (("{", 1), (None, 0)):
        path = broken / "photometry.json"
        path.unlink() if content is None else path.write_text(content)
        with pytest.raises(SystemExit) as stop:
            main(["report", str(broken), "--no-render"])
        assert stop.value.code == code
        assert "photometry.json" in capsys.readouterr().err.replace("\n", "")


def test_an_only_config_still_gives_a_page(run, tmp_path):
    shutil.copy(run / "config.json", tmp_path / "config.json")
    text = write_report(tmp_path).read_text()
    assert headings(text)[0] == "What to watch"
    assert "Configuration" in headings(text)


def test_names_are_text_never_markup(run, tmp_path):
    odd = copy_run(run, tmp_path / "run")
    name = '<img src="http://x/">&$a$.png'

    def rename(photometry):
        photometry["views"][1].update(image=name, camera=name)

    edit(odd / "photometry.json", rename)
    edit(odd / "metrics.json", lambda m: m["notes"].append("<b>bold</b>"))
    text = write_report(odd, render=False).read_text()
    assert '<img src="http' not in text
    assert "<b>" not in text
    assert html.escape(name, quote=True) in text


def test_truth_exif_and_errors_are_drawn(run):
    files = read_run(run)
    for i, view in enumerate(files.train):
        view["exif_ev"] = (view["exposure_ev"] or 0) - 7 + (0.5 if i == 0 else 0)
    truth = {v["image"]: 3 * v["exposure"] for v in files.train}
    text = words_of(report_page(files, SceneMeasurements(true_exposures=truth)))
    assert "RMS error 0.000 stops" in text
    assert "Crosses, dotted: EXIF" in text
    for label in ("found", "held out", "EXIF", "true"):
        assert f" {label} " in text
    assert "EXIF disagrees with the pixels" in text


def test_error_bars_are_those_of_the_views(run):
    def marks(error):
        files = read_run(run)
        for view in files.train:
            view["exposure_ev_error"] = error
        section = re.search(
            r'id="exposures".*?</section>', report_page(files, SceneMeasurements()), re.S
        )
        return section[0].count("<use"), words_of(section[0])

    with_errors, said = marks(0.04)
    without, nothing = marks(None)
    assert with_errors == without + 2 * 2 * 4
    assert "two standard errors, at most ±0.08 stops" in said
    assert "no error bars" in nothing


def test_changes_of_resolution_and_freezing_are_marked(run):
    files = read_run(run)
    files.log[:] = [
        {
            **files.log[0],
            "step": 10 * i,
            "progress": i / 100,
            "shrink": 4 if i < 25 else 2 if i < 50 else 1,
        }
        for i in range(1, 101)
    ]
    said = words_of(report_page(files, SceneMeasurements()))
    for mark in ("images at 1/2 from step 250", "full-size images from step 500"):
        assert mark in said
    assert "exposures move from step 600" in said


def test_two_cameras_get_a_panel_each_and_many_share_one(run):
    files = read_run(run)
    for i, view in enumerate(files.views):
        view["camera"] = "left" if i < 3 else "right"
    text = words_of(report_page(files, SceneMeasurements()))
    assert "camera left" in text
    assert "camera right" in text
    for i, view in enumerate(files.views):
        view["camera"] = str(i)
    text = words_of(report_page(files, SceneMeasurements()))
    assert "all photographs" in text
    assert "camera 0" not in text


def test_gammas_are_drawn_where_they_are_modelled(run):
    files = read_run(run)
    files.photometry["model"] = "view_exposure_gamma"
    for i, view in enumerate(files.train):
        view.update(gamma=2.0 + 0.1 * i, gamma_error=0.02)
    text = words_of(report_page(files, SceneMeasurements()))
    assert "Gamma turns the tone curve about mid-grey" in text
    assert "γ 2.00" in text
    assert "γ 2.30" in text
    files.photometry["model"] = "view_exposure"
    for view in files.train:
        view.update(gamma=2.2)
    assert "Gamma was not modelled" in words_of(report_page(files, SceneMeasurements()))


@pytest.mark.parametrize("name", ["page.pdf", "page", "folder.html", "file/page.html"])
def test_where_no_page_can_be_written(run, tmp_path, capsys, name):
    (tmp_path / "folder.html").mkdir()
    (tmp_path / "file").write_text("")
    with pytest.raises(SystemExit) as stop:
        main(["report", str(run), "--no-render", "--out", str(tmp_path / name)])
    assert stop.value.code == 2
    assert name in capsys.readouterr().err


def test_not_a_run_folder(capsys, tmp_path):
    with pytest.raises(SystemExit) as stop:
        main(["report", str(tmp_path)])
    assert stop.value.code == 2
    assert "config.json is missing" in capsys.readouterr().err
