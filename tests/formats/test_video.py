import av
import numpy as np
import pytest

from p2gs_jax.errors import UserError
from p2gs_jax.formats.video import open_video


def read(path):
    with av.open(str(path)) as container:
        frames = [f.to_ndarray(format="rgb24") for f in container.decode(video=0)]
        stream = container.streams.video[0]
        return frames, stream.codec_context, float(stream.average_rate or 0)


def patches(colours, size=(64, 48)):
    width, height = size
    out = np.zeros((height, width, 3), np.float32)
    for k, c in enumerate(colours):
        out[:, k * width // len(colours) : (k + 1) * width // len(colours)] = c
    return out


def test_frames_keep_their_number_order_and_colours(tmp_path):
    colours = np.array([[1, 0, 0], [0, 0.5, 0], [0.2, 0.2, 0.9], [0.5, 0.5, 0.5]])
    with open_video(tmp_path / "v.mp4", 64, 48, 30) as add:
        for k in range(5):
            add(patches(np.roll(colours, k, axis=0)))
    frames, context, rate = read(tmp_path / "v.mp4")
    assert len(frames) == 5
    assert (context.name, rate) == ("h264", 30)
    for k, frame in enumerate(frames):
        got = frame[24, 8::16] / 255
        np.testing.assert_allclose(got, np.roll(colours, k, axis=0), atol=0.03)


def test_odd_sizes_are_cut_and_smaller_frames_centred(tmp_path):
    with open_video(tmp_path / "v.mp4", 65, 49, 24) as add:
        add(np.ones((49, 65, 3), np.float32))
        add(np.ones((24, 32, 3), np.float32))
    (large, small), _, _ = read(tmp_path / "v.mp4")
    assert large.shape == (48, 64, 3)
    assert large.min() > 250
    assert small[12:36, 16:48].min() > 230
    assert small[:10].max() < 20
    assert small[:, :14].max() < 20


def fail(path):
    with open_video(path, 64, 48, 24) as add:
        add(np.ones((48, 64, 3), np.float32))
        raise RuntimeError("no light")


def test_nothing_is_left_of_a_video_that_failed(tmp_path):
    with pytest.raises(RuntimeError, match="no light"):
        fail(tmp_path / "v.mp4")
    assert list(tmp_path.iterdir()) == []


def test_a_failure_keeps_the_video_that_was_there(tmp_path):
    (tmp_path / "v.mp4").write_bytes(b"old")
    with pytest.raises(RuntimeError, match="no light"):
        fail(tmp_path / "v.mp4")
    assert (tmp_path / "v.mp4").read_bytes() == b"old"


def test_a_tiny_video_is_refused(tmp_path):
    with pytest.raises(UserError, match="too few"), open_video(tmp_path / "v.mp4", 64, 9, 24):
        pass
