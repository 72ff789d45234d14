"""Known exposures are read from CSV or EXIF, and faults of a file are named."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from scene.helpers import make_view, refused

from p2gs_jax.config import FitConfig, PhotometryConfig
from p2gs_jax.photometry.calibrate import options_of
from p2gs_jax.scene.exposures import check_source, read_known_exposures, stated_ev
from p2gs_jax.types import Scene


def views(*names, exif=None):
    return [
        dataclasses.replace(make_view(Path(n), size=(4, 4), exif_ev=exif), name=n) for n in names
    ]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("image,exposure\na.png,2\nb.png,0.5\n", [1, -1]),
        ("image,ev\na.png,1\nb.png,-1\n", [1, -1]),
        ("\ufefffile, exposure_time_s\na.png,4\nb.png,1\n", [2, 0]),
        ("# comment\nimage,exposure\nb.png,0.5\nz.png,3\n", [np.nan, -1]),
        ("#comment\nimage,exposure\n# a.png,2\n#.png,0.5\n", [np.nan, np.nan, -1]),
    ],
)
def test_columns_and_names_of_a_csv_file_are_read(tmp_path, text, expected):
    path = tmp_path / "e.csv"
    path.write_text(text, encoding="utf-8")
    named = views("front/a.png", "b.png", "#.png")[: len(expected)]
    found = read_known_exposures(str(path), named) / np.log(2)
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_names_match_whole_or_by_their_end_and_never_several_views(tmp_path):
    path = tmp_path / "e.csv"
    rig = views(*(f"rig/cam{k}/{n}.png" for k in range(3) for n in "ab"))
    path.write_text("image,ev\nrig\\cam0\\a.png,1\ncam1/a,2\nrig/cam2/b.png,3\n")
    found = read_known_exposures(str(path), rig) / np.log(2)
    np.testing.assert_allclose(found, [1, np.nan, 2, np.nan, np.nan, 3])
    for rows, words in (
        ("a.png,1\n", "a.png may be rig/cam0/a.png and rig/cam1/a.png"),
        ("cam0/a.png,1\nrig/cam0/a.png,2\n", "rig/cam0/a.png has two exposures"),
        ("cam0/a.png,1\ncam0/a.png,2\n", "line 3: cam0/a.png has two exposures"),
    ):
        path.write_text("image,ev\n" + rows)
        with refused(words):
            read_known_exposures(str(path), rig)
    # A name stays ambiguous if all but one of its views are held out.
    path.write_text("image,ev\na.png,1\n")
    with refused("a.png may be"):
        read_known_exposures(str(path), rig[:1], among=rig)
    # A whole name is not the end of another.
    both = views("a.png", "cam0/a.png")
    np.testing.assert_allclose(read_known_exposures(str(path), both) / np.log(2), [1, np.nan])


def test_rows_that_name_no_view_are_counted(tmp_path):
    path = tmp_path / "e.csv"
    path.write_text("image,ev\nfront/a.png,1\nb,2\nc.png,3\n")
    held_out = dataclasses.replace(views("b.png")[0], split="test")
    points = np.zeros((0, 3), np.float32)
    scene = Scene(tmp_path, "images", (*views("front/a.png"), held_out), points, None)
    cfg = FitConfig(photometry=PhotometryConfig(known=str(path)))
    known = options_of(cfg, scene).known
    assert known is not None
    assert known.unused == ("c.png",)


def test_exposures_of_exif_are_read():
    found = read_known_exposures("exif", [*views("a", exif=1.5), *views("b")])
    np.testing.assert_allclose(found / np.log(2), [1.5, np.nan])
    for read, option in (
        (read_known_exposures, "--known-exposures"),
        (stated_ev, "--compare-with"),
    ):
        with refused("EXIF", f"give a CSV file to {option}"):
            read("exif", views("a"))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("image,value\na.png,1\n", "columns image, value"),
        ("image,exposure\na.png,-1\n", "line 2"),
        ("image,ev\na.png,0\nb.png,2000\nc.png,1\n", "exposure of b.png is [+]1333 stops from"),
        ("image,ev\na.png,0,5\n", "e.csv, line 2: has 3 fields, the header 2"),
        ("# by hand\n\nimage,exposure\n\na.png,-1\n", "line 5"),
        ("image,exposure\nother.png,1\n", "names none of the 1"),
        pytest.param(f"image,ev\n{'x' * 200_000},1\n", "e.csv is not a CSV file", id="long"),
    ],
)
def test_broken_csv_files_are_refused(tmp_path, text, words):
    (tmp_path / "e.csv").write_text(text)
    with refused(words):
        read_known_exposures(str(tmp_path / "e.csv"), views("a.png"))
    with refused("cannot be read"):
        check_source("nowhere.csv")
