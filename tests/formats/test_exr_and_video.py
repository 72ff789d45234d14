"""EXR, PNG, video and false colour, read by other libraries; broken files are refused."""

import av
import cv2
import jax.numpy as jnp
import numpy as np
import OpenEXR
import pytest
from scipy.spatial.transform import Rotation

from p2gs_jax import Camera, DisplayTransform, UserError
from p2gs_jax.config import CameraFormation, PhotometryConfig
from p2gs_jax.formats.exr import read_exr, write_exr
from p2gs_jax.formats.false_color import depth_color, false_color, luminance, stops
from p2gs_jax.formats.frames import open_video, write_png
from p2gs_jax.scene.convert.readers import ExifSettings
from p2gs_jax.scene.rigid import pose_of

WIDTH, HEIGHT = 90, 70


def camera():
    turn = Rotation.from_euler("xyz", [0.2, -0.4, 0.1]).as_matrix()
    K = np.array([[80.0, 0, 41.0], [0, 84.0, 37.0], [0, 0, 1]])
    return Camera(jnp.asarray(pose_of(turn, [0.5, -1.0, 2.5])), jnp.asarray(K), WIDTH, HEIGHT)


def header_of(path, **kwargs):
    write_exr(path, np.full((HEIGHT, WIDTH, 3), 0.25, np.float32), camera=camera(), **kwargs)
    with OpenEXR.File(str(path)) as file:
        return dict(file.header())


def test_exr_holds_radiance_exposure_and_depth(tmp_path):
    linear = np.exp2(np.random.default_rng(0).uniform(-10, 6, (7, 9, 3))).astype(np.float32)
    depth, alpha = np.full((7, 9), 4.0, np.float32), np.full((7, 9), 0.5, np.float32)
    path = tmp_path / "a.exr"
    transform = DisplayTransform(2.0, 2.1, PhotometryConfig())
    write_exr(path, linear, depth=depth, alpha=alpha, transform=transform)
    back, _, header = read_exr(path)
    np.testing.assert_allclose(back, linear, rtol=1e-3)
    assert header["p2gsExposure"] == 2.0
    assert header["p2gsExposureEV"] == 1.0
    assert header["p2gsGamma"] == pytest.approx(2.1)
    np.testing.assert_allclose(
        header["chromaticities"], (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329)
    )
    np.testing.assert_allclose(header["adoptedNeutral"], (0.3127, 0.329))
    assert "whiteLuminance" not in header, "radiance is relative"
    assert "worldToCamera" not in header
    assert not {"p2gsWhiteBalance", "p2gsVignettingRed"} & set(header)
    with OpenEXR.File(str(path), separate_channels=True) as file:
        np.testing.assert_allclose(file.channels()["Z"].pixels, 8.0)


def test_matrices_of_the_header_project_points_like_the_camera(tmp_path):
    header, cam = header_of(tmp_path / "a.exr"), camera()
    viewmat, K = np.asarray(cam.viewmat, float), np.asarray(cam.K, float)
    matrices = [header[name] for name in ("worldToCamera", "worldToNDC", "p2gsIntrinsics")]
    assert {matrix.dtype for matrix in matrices} == {np.dtype(np.float32)}, "as is standard"
    # The principal point is 41 pixels from the left and 37 from the top: y points down.
    for local in ([0.3, -0.2, 2.0], [-1.0, 0.8, 5.0], [0.0, 0.0, 3.0]):
        world = np.append(viewmat[:3, :3].T @ (np.array(local) - viewmat[:3, 3]), 1.0)
        u, v, w = K @ local
        # Imath: a row vector times the matrix, divided by its last component.
        x, y, _, weight = world @ header["worldToNDC"].astype(float)
        seen = [x / weight * WIDTH, y / weight * HEIGHT]
        np.testing.assert_allclose(seen, [u / w, v / w], atol=1e-3)
        left_handed = world @ header["worldToCamera"].astype(float)
        np.testing.assert_allclose(left_handed, [local[0], -local[1], local[2], 1.0], atol=1e-5)
    np.testing.assert_allclose(header["p2gsViewmat"], viewmat, atol=1e-6)
    np.testing.assert_allclose(header["p2gsIntrinsics"], camera().K)
    # The screen window bounds the image at distance 1; more of it lies above the axis.
    width, (x, y) = header["screenWindowWidth"], header["screenWindowCenter"]
    np.testing.assert_allclose([x - width / 2, x + width / 2], [-41 / 80, (90 - 41) / 80])
    assert y == pytest.approx((37 - (70 - 37)) / 2 / 84)


def test_exif_values_have_standard_attributes(tmp_path):
    path = tmp_path / "a.exr"
    exif = ExifSettings(time=1 / 60, aperture=2.8, iso=None, date="2010:10:12 14:43:07")
    header = header_of(path, shot=exif)
    assert header["expTime"] == pytest.approx(1 / 60)
    assert header["aperture"] == pytest.approx(2.8)
    assert header["capDate"] == "2010:10:12 14:43:07"
    assert "isoSpeed" not in header
    assert not {"expTime", "aperture", "capDate"} & set(header_of(path))


def test_the_header_holds_white_balance_and_vignetting(tmp_path):
    linear, path = np.ones((4, 6, 3), np.float32), tmp_path / "a.exr"
    for rows in (((-0.3, 0.1, 0.0),), ((-0.3, 0.1, 0.0), (-0.2, 0.0, 0.0), (-0.1, 0.0, 0.05))):
        cfg = PhotometryConfig(cameras=(CameraFormation("a"), CameraFormation("b", rows)))
        balance = (0.2, -0.05, -0.15)
        transform = DisplayTransform(1.0, 2.2, cfg, white_balance=balance, camera=1)
        write_exr(path, linear, transform=transform)
        header = read_exr(path)[-1]
        np.testing.assert_allclose(header["p2gsWhiteBalance"], np.exp(balance), rtol=1e-6)
        each = rows if len(rows) == 3 else rows * 3
        for name, row in zip(("Red", "Green", "Blue"), each, strict=True):
            np.testing.assert_allclose(header[f"p2gsVignetting{name}"], row, rtol=1e-6)
    write_exr(path, linear, transform=transform.without_place())
    assert "p2gsVignettingRed" not in read_exr(path)[-1]


@pytest.mark.parametrize(
    ("value", "pixel"),
    [
        (65504.0, np.float16),
        (65505.0, np.float32),
        (2.0**-14, np.float16),
        (6e-5, np.float32),
        (0.0, np.float16),
    ],
)
def test_exr_switches_to_float_where_half_ends(tmp_path, value, pixel):
    linear = np.full((2, 3, 3), value, np.float32)
    write_exr(tmp_path / "a.exr", linear, alpha=np.ones((2, 3), np.float32))
    with OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True) as file:
        assert {c: file.channels()[c].pixels.dtype for c in "RGBA"} == dict.fromkeys("RGBA", pixel)
    np.testing.assert_array_equal(read_exr(tmp_path / "a.exr")[0], linear)
    (tmp_path / "x.exr").write_bytes(b"no")
    with pytest.raises(UserError, match=r"x\.exr"):
        read_exr(tmp_path / "x.exr")


def test_png_rounds_and_keeps_the_channel_order(tmp_path):
    write_png(tmp_path / "a.png", np.array([[[1.0, 0.5, 0.0], [2.0, -1.0, np.nan]]], np.float32))
    back = cv2.imread(str(tmp_path / "a.png"))[..., ::-1]
    np.testing.assert_array_equal(back, [[[255, 128, 0], [255, 0, 0]]])


def grey(values):
    return np.repeat(np.asarray(values, np.float32)[None, :, None], 3, axis=-1)


def test_colours_step_at_whole_stops_and_near_is_bright():
    np.testing.assert_allclose(stops(grey([0.5, 1, 2, 4]), middle=1.0)[0], [-1, 0, 1, 2], atol=1e-5)
    np.testing.assert_allclose(luminance(np.array([0.0, 1, 0])), 0.7152)
    levels = [0, 2.0**-20, 2.0**-5.5, 1.0, 1.9, 2.1, 30, 2.0**5.5, 1e30]
    shown = luminance(false_color(grey(levels), middle=1.0)[0])
    assert (np.diff(shown) > 0).tolist() == [False, False, True, False, True, True, True, False]
    depth, alpha = np.array([[2.0, 8.0, 0.0]]), np.array([[1.0, 1.0, 0.0]])
    limits = (2.0, 10.0)
    shown = depth_color(depth, alpha, limits)
    assert luminance(shown)[0, 0] > luminance(shown)[0, 1] > 0
    assert not shown[0, 2].any()
    # The same surface with an opacity of 0.6: depth is divided by it.
    np.testing.assert_allclose(depth_color(depth * 0.6, alpha * 0.6, limits), shown)


def frames_of(path):
    with av.open(str(path)) as container:
        frames = [f.to_ndarray(format="rgb24") for f in container.decode(video=0)]
        stream = container.streams.video[0]
        return frames, stream.codec_context, float(stream.average_rate or 0)


def test_frames_keep_their_order_and_colours_and_odd_sizes_are_cut(tmp_path):
    colours = np.array([[1, 0, 0], [0, 0.5, 0], [0.2, 0.2, 0.9], [0.5, 0.5, 0.5]], np.float32)
    with open_video(tmp_path / "v.mp4", 64, 48, 30) as add:
        for k in range(5):
            add(np.tile(np.repeat(np.roll(colours, k, axis=0), 16, axis=0), (48, 1, 1)))
    frames, context, rate = frames_of(tmp_path / "v.mp4")
    assert len(frames) == 5
    assert (context.name, rate) == ("h264", 30)
    for k, frame in enumerate(frames):
        np.testing.assert_allclose(frame[24, 8::16] / 255, np.roll(colours, k, axis=0), atol=0.03)
    with open_video(tmp_path / "v.mp4", 65, 49, 24) as add:
        add(np.ones((49, 65, 3), np.float32))
        add(np.ones((24, 32, 3), np.float32))
    (large, small), _, _ = frames_of(tmp_path / "v.mp4")
    assert large.shape == (48, 64, 3)
    assert large.min() > 250
    assert small[12:36, 16:48].min() > 230
    assert small[:10].max() < 20
    assert small[:, :14].max() < 20


def test_a_failure_keeps_the_old_video(tmp_path):
    (tmp_path / "v.mp4").write_bytes(b"old")

    def fail():
        with open_video(tmp_path / "v.mp4", 64, 48, 24) as add:
            add(np.ones((48, 64, 3), np.float32))
            raise RuntimeError("no light")

    with pytest.raises(RuntimeError, match="no light"):
        fail()
    assert [p.read_bytes() for p in tmp_path.iterdir()] == [b"old"]
    with pytest.raises(UserError, match="too few"), open_video(tmp_path / "v.mp4", 64, 9, 24):
        pass
