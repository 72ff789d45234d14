"""Which frames are chosen, and what of them reaches the scene."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from scene.made_videos import HLG, room, turn, write_video

from p2gs_jax.config import DataConfig
from p2gs_jax.errors import UserError
from p2gs_jax.scene import find_scene
from p2gs_jax.scene.motion import Tracker, choose_frames, normalised, thinned
from p2gs_jax.scene.survey import survey
from p2gs_jax.scene.video import RECORD, read_video


def grey(position: float, yaw: float = 0.0, gain: float = 1.0) -> np.ndarray:
    return cv2.cvtColor((room(position, yaw) * gain).astype(np.uint8), cv2.COLOR_RGB2GRAY)


def chosen(path: list[tuple[float, float]], **changes: np.ndarray) -> list[int]:
    frames = [grey(*place) for place in path]
    for number, frame in changes.items():
        frames[int(number[1:])] = frame
    return [one.number for one in choose_frames(enumerate(frames))]


WALK = [(0.03 * k, 0.0) for k in range(50)]


def test_walking_gives_frames_at_even_distances() -> None:
    numbers = chosen(WALK)
    assert 5 <= len(numbers) <= 30
    steps = np.diff(numbers[:-1])
    assert steps.max() <= 2.5 * steps.min()


def test_speed_and_frame_rate_do_not_matter() -> None:
    slow = chosen([(0.015 * k, 0.0) for k in range(100)])
    assert abs(len(slow) - len(chosen(WALK))) <= 2


def test_a_camera_that_rests_gives_one_frame() -> None:
    assert len(chosen([(0.0, 0.0)] * 30)) == 1
    resting = [*WALK[:25], *([WALK[24]] * 40), *WALK[25:]]
    assert abs(len(chosen(resting)) - len(chosen(WALK))) <= 1


def test_exposure_is_no_motion() -> None:
    frames = [grey(0.0, 0.0, gain) for gain in np.linspace(0.3, 1.0, 40)]
    assert len(choose_frames(enumerate(frames))) == 1


def test_turning_on_the_spot_shows_no_parallax() -> None:
    def way(position: float, yaw: float):
        tracker = Tracker(normalised(grey(0, 0)))
        for k in range(1, 11):
            found = tracker.follow(normalised(grey(position * k / 10, yaw * k / 10)))
        return found

    turned, walked = way(0, 0.08), way(0.16, 0)
    assert turned.displacement > 0.05
    assert walked.parallax > 4 * turned.parallax


def test_of_neighbours_the_sharp_one_is_taken() -> None:
    numbers = chosen(WALK)
    row = len(numbers) // 2
    blurred = {f"n{numbers[row]}": cv2.GaussianBlur(grey(*WALK[numbers[row]]), (15, 15), 4)}
    other = chosen(WALK, **blurred)
    assert numbers[row] not in other
    assert min(abs(n - numbers[row]) for n in other) <= 6


def test_a_blurred_frame_is_waited_out() -> None:
    # Every frame is due once the camera walks.
    steps = [*([(0.0, 0.0)] * 6), *((0.13 * k, 0.0) for k in range(1, 6))]
    assert 8 in chosen(steps)
    other = chosen(steps, n8=cv2.GaussianBlur(grey(*steps[8]), (15, 15), 4))
    assert 8 not in other
    assert 9 in other


def test_thinning_keeps_both_ends() -> None:
    assert thinned(list(range(10)), 20) == list(range(10))
    few = thinned(list(range(100)), 7)
    assert len(few) == 7
    assert (few[0], few[-1]) == (0, 99)


def read(path: Path, work: Path, **options):
    return read_video(path, DataConfig(**options), work, lambda message: None)


@pytest.fixture(scope="module")
def film(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("film") / "walk.mp4"
    write_video(path, [room(*place) for place in WALK])
    return path


def test_frames_are_kept_in_the_cache(film: Path, tmp_path: Path) -> None:
    found = read(film, tmp_path)
    record = json.loads((tmp_path / "video" / RECORD).read_text())
    assert [frame["file"] for frame in record["frames"]] == [path.name for path in found.paths]
    assert found.known is None
    assert found.notes[0].startswith(
        f"Of 50 frames of the video {len(found.paths)} are used: sharp"
    )
    second = record["frames"][1]
    stored = cv2.imread(str(found.paths[1]))[..., ::-1].astype(float)
    near = range(second["frame"] - 2, second["frame"] + 3)
    errors = {n: np.abs(stored - room(*WALK[n])).mean() for n in near}
    assert min(errors, key=lambda n: errors[n]) == second["frame"]
    assert second["time"] == pytest.approx(second["frame"] / 30, abs=1e-3)
    before = found.paths[0].stat().st_mtime_ns
    assert read(film, tmp_path).paths[0].stat().st_mtime_ns == before


def test_by_number(film: Path, tmp_path: Path) -> None:
    found = read(film, tmp_path, every=10)
    assert [path.name for path in found.paths] == [f"{n:06d}.png" for n in range(0, 50, 10)]
    few = read(film, tmp_path, every=10, max_frames=3)
    assert [path.name for path in few.paths] == ["000000.png", "000020.png", "000040.png"]
    assert "thinned from 5 (--max-frames)" in few.notes[0]


def test_one_frame_or_no_motion(film: Path, tmp_path: Path) -> None:
    write_video(tmp_path / "one.mp4", [room(0)])
    with pytest.raises(UserError, match="holds one frame"):
        read(tmp_path / "one.mp4", tmp_path)
    write_video(tmp_path / "still.mp4", [room(0)] * 30)
    with pytest.raises(UserError, match="1 of 30 frames would be used") as error:
        read(tmp_path / "still.mp4", tmp_path)
    assert "--every" in str(error.value.fix)


def test_a_video_that_breaks_off_is_used_as_far_as_it_goes(film: Path, tmp_path: Path) -> None:
    path = tmp_path / "cut.mkv"
    write_video(path, [room(*place) for place in WALK])
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * 2 // 3])
    found = read(path, tmp_path)
    assert len(found.paths) >= 3


def test_hdr_and_rotation_reach_the_photographs(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    pictures = [room(*place).astype(np.uint16) * 257 for place in WALK[::4]]
    write_video(path, pictures, codec="libx264", layout="yuv420p10le", coding=HLG)
    turn(path, 90)
    found = read(path, tmp_path)
    assert found.known == "HLG video"
    stored = cv2.imread(str(found.paths[0]), cv2.IMREAD_UNCHANGED)
    assert stored.dtype == np.uint16
    assert stored.shape == (240, 136, 3)


def test_a_video_is_a_scene(film: Path) -> None:
    assert find_scene(film, DataConfig()) == (film,)
    found = survey(film, DataConfig())
    assert found.format == "video"
    assert found.cameras[0].photographs == 50
    assert found.cameras[0].size == (240, 136)
