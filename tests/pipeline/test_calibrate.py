"""`p2gs-jax calibrate`: a street with known exposures, finished runs, stacks, wrong input."""

import csv
import json

import cv2
import numpy as np
import pytest

import p2gs_jax
from p2gs_jax import UserError, calibrate, calibrate_run, calibrate_stack, exposure_error
from p2gs_jax.cli.tables import print_calibration
from p2gs_jax.photometry.sources.stack import read_stack, stack_colors
from p2gs_jax.run.photometry_files import read_photometry
from p2gs_jax.synth.sensor import read_true_exposures


def test_exposures_of_a_street_are_recovered(noisy_street, tmp_path, capsys):
    result = calibrate(noisy_street, tmp_path / "out")
    saved = read_photometry(tmp_path / "out" / "photometry.json")
    truth = read_true_exposures(noisy_street)
    pairs = np.array([(v["exposure"], truth[v["image"]]) for v in saved["views"]])
    assert exposure_error(*pairs.T)["ev"] < 0.05
    assert result.selection.solution.model == "view_exposure"
    assert any(m.startswith("Model kept: ") for m in result.messages)
    assert all(v["exposure_ev_error"] < 0.2 for v in saved["views"])
    assert (tmp_path / "out" / "calibration.png").stat().st_size > 10_000
    candidates = json.loads((tmp_path / "out" / "calibration.json").read_text())["candidates"]
    assert candidates[0]["codes"] == 0
    assert max(c["codes"] for c in candidates) > 1
    # A view is one line of 80 characters, with its whole name.
    print_calibration(result, tmp_path / "out")
    printed = [row for line in capsys.readouterr().out.splitlines() if (row := line.split())]
    shown = {row[0]: float(row[1]) for row in printed if row[0] in truth and row[2] == "+-"}
    assert shown == {v["image"]: round(v["exposure_ev"], 3) for v in saved["views"]}


def test_a_photograph_whose_exif_and_pixels_disagree_is_reported(shared_data, tmp_path):
    root = shared_data("sceaux_castle")
    fixed = {"photometry.select": False, "photometry.model": "view_exposure"}
    cfg = p2gs_jax.with_fields(p2gs_jax.preset("robust"), fixed)
    result = calibrate(root, tmp_path / "out", cfg, compare_with=str(root / "exposures.csv"))
    assert result.agreement.correlation > 0.7
    assert result.agreement.disagrees[[v.name for v in result.views].index("100_7109.jpg")]
    assert any("disagrees with the pixels" in m for m in result.messages)


def test_a_short_run_is_calibrated_from_its_depth(finished_run, tmp_path):
    run = p2gs_jax.load_run(finished_run)
    found = calibrate_run(finished_run, tmp_path / "out", run.cfg)
    saved = read_photometry(tmp_path / "out" / "photometry.json")["views"]
    assert [v["image"] for v in saved] == [run.scene.views[i].name for i in run.scene.train_indices]
    assert all(v["exposure"] > 0 for v in saved)
    assert (tmp_path / "out" / "calibration.png").is_file()
    # Dense seeds lie on the surfaces: even a short run has depth to warp through.
    assert found.observations > 1000
    assert set(found.seconds) == {"reading", "adjustment"}


def write_stack(folder, times, response=lambda x: x ** (1 / 2.2), drift=None):
    """Write an HDR picture at exposures `times`; `drift(frame, linear)` is a factor on light."""
    rng = np.random.default_rng(0)
    base = cv2.resize(rng.normal(0, 1, (12, 16, 1)), (320, 240), interpolation=cv2.INTER_CUBIC)
    log = 1.8 * base[..., None] + 0.2 * np.array([0.3, 0.0, -0.3]) - 1.5
    fine = cv2.GaussianBlur(rng.normal(0, 1, (240, 320)), (0, 0), 2)
    linear = np.exp(log + fine[..., None])
    folder.mkdir(parents=True, exist_ok=True)
    for i, t in enumerate(times):
        exposed = linear * t * (1 if drift is None else drift(i, linear))
        noisy = np.clip(response(exposed), 0, 1) + rng.normal(0, 0.002, linear.shape)
        cv2.imwrite(str(folder / f"{i:02d}.png"), np.rint(np.clip(noisy, 0, 1) * 255)[..., ::-1])


def s_curve(x):
    return np.where(x > 0, x**0.7 / (x**0.7 + 0.35), 0)


@pytest.mark.parametrize("response", [lambda x: x ** (1 / 2.2), s_curve])
def test_exposures_of_a_stack_are_recovered(tmp_path, response):
    times = 2.0 ** np.arange(3, -4, -1)
    write_stack(tmp_path / "s", times, response)
    result = calibrate_stack(tmp_path / "s")
    use = result.details["signal"]
    assert use.sum() >= 6
    error = exposure_error(np.exp(result.solution.log_exposures[use]), times[use])
    assert error["ev_scale_power"] < 0.05
    assert result.details["one_response"]


def test_the_command_writes_the_calibration_of_a_stack(tmp_path, succeeded):
    times = 2.0 ** np.arange(2, -3, -1)
    write_stack(tmp_path / "s", times)
    listed = tmp_path / "times.csv"
    rows = (f"{i:02d}.png,{t}" for i, t in enumerate(times))
    listed.write_text("image,exposure_time_s\nnosuch.png,1\n" + "\n".join(rows))
    out = tmp_path / "out"
    argv = ("calibrate", tmp_path / "s", "--static", "--out", out)
    text = succeeded(*argv, "--compare-with", listed)
    assert all(word in text for word in ("00.png", "stated", "signal", "response "))
    saved = read_photometry(out / "photometry.json")
    assert [v["image"] for v in saved["views"]] == [f"{i:02d}.png" for i in range(len(times))]
    assert "stretched together" in saved["gauge"]
    assert saved["curve"]["base"] in ("srgb", "power")
    assert "nan" not in text
    details = json.loads((out / "calibration.json").read_text())
    assert details["one_response"]
    assert any("times.csv of" in m for m in details["messages"])
    assert f"1 exposures of {listed} belong to no view: nosuch.png." in details["messages"]
    assert (out / "calibration.png").stat().st_size > 10_000


@pytest.mark.parametrize("moved", [10, 24])
def test_a_moved_frame_is_aligned_or_reported(tmp_path, moved):
    write_stack(tmp_path, [1.0, 1.4, 2.0])
    path = sorted(tmp_path.glob("*.png"))[1]
    cv2.imwrite(str(path), np.roll(cv2.imread(str(path)), moved, axis=1))
    found = stack_colors(read_stack(tmp_path), 0)
    assert found.astray.tolist() == ([False] * 3 if moved == 10 else [False, True, True])
    assert moved > 10 or found.shifts.tolist() == [[0, 0], [-moved, 0], [0, 0]]


def test_a_stack_with_local_tone_mapping_is_recognised(tmp_path):
    def local(i, linear):
        # Shadows are lifted, more in some regions, and differently from frame to frame.
        regions = cv2.resize(
            np.random.default_rng(i).normal(0, 1, (5, 6)), (320, 240), interpolation=cv2.INTER_CUBIC
        )
        return np.exp(0.25 * regions)[..., None]

    write_stack(tmp_path / "s", 2.0 ** np.arange(3, -4, -1), drift=local)
    result = calibrate_stack(tmp_path / "s")
    assert not result.details["one_response"]
    assert any("One response does not explain" in m for m in result.messages)


def test_results_among_the_photographs_of_a_stack_are_refused(tmp_path):
    write_stack(tmp_path / "images", [1.0, 2.0])
    with pytest.raises(UserError, match="holds the photographs"):
        calibrate_stack(tmp_path, tmp_path / "images")
    assert len(list((tmp_path / "images").iterdir())) == 2


def test_stacks_of_several_sizes_or_with_broken_files_are_refused(tmp_path):
    write_stack(tmp_path / "s", [1.0, 2.0])
    cv2.imwrite(str(tmp_path / "s" / "zz.png"), np.zeros((10, 10, 3), np.uint8))
    with pytest.raises(UserError, match="give photographs of one size"):
        read_stack(tmp_path / "s")
    for path in (tmp_path / "s").iterdir():
        cv2.imwrite(str(path), np.zeros((10, 10, 3), np.uint8))
    with pytest.raises(UserError, match="give larger photographs"):
        read_stack(tmp_path / "s")
    for name in ("zz.heic", "merged.exr", "._a.CR2"):
        (tmp_path / "s" / name).touch()
    (tmp_path / "s" / "zz.png").write_bytes(b"no image")
    with pytest.raises(UserError, match="cannot decode"):
        read_stack(tmp_path / "s")
    (tmp_path / "s" / "zz.png").unlink()
    with pytest.raises(UserError, match=r"zz\.heic is a photograph that --static does not read"):
        read_stack(tmp_path / "s")


@pytest.mark.parametrize(
    "name",
    [
        "hdr_living_room",
        *(pytest.param(n, marks=pytest.mark.slow) for n in ("hdr_memorial", "hdr_taipei_night")),
    ],
)
def test_exposures_of_real_stacks_are_recovered(shared_data, name):
    """Recovered exposures agree with the listed times in frames that carry signal."""
    folder = shared_data(name)
    result = calibrate_stack(folder)
    with (folder / "exposures.csv").open(newline="") as file:
        listed = {r["file"]: float(r["exposure_time_s"]) for r in csv.DictReader(file)}
    times = np.array([listed[n] for n in (v.name for v in result.views)])
    use = result.details["signal"]
    error = exposure_error(np.exp(result.solution.log_exposures[use]), times[use])
    assert error["ev_scale_power"] <= 0.042
    assert result.details["one_response"]


def test_a_phone_without_a_single_response_is_recognised(shared_data):
    assert not calibrate_stack(shared_data("hdr_iphone_night")).details["one_response"]
