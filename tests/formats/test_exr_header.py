"""The header follows OpenEXR's standard attributes, as its own library reads them."""

import struct

import jax.numpy as jnp
import numpy as np
import OpenEXR
import pytest
from scipy.spatial.transform import Rotation

from p2gs_jax.config import CameraFormation, PhotometryConfig
from p2gs_jax.formats.exr import read_exr, write_exr
from p2gs_jax.photometry.display import DisplayTransform
from p2gs_jax.scene.convert.headers import ExifSettings
from p2gs_jax.types import Camera

WIDTH, HEIGHT = 90, 70


def camera():
    viewmat = np.eye(4)
    viewmat[:3, :3] = Rotation.from_euler("xyz", [0.2, -0.4, 0.1]).as_matrix()
    viewmat[:3, 3] = [0.5, -1.0, 2.5]
    K = np.array([[80.0, 0, 41.0], [0, 84.0, 37.0], [0, 0, 1]])
    return Camera(jnp.asarray(viewmat), jnp.asarray(K), WIDTH, HEIGHT)


def written(path, **kwargs):
    linear = np.full((HEIGHT, WIDTH, 3), 0.25, np.float32)
    write_exr(path, linear, camera=camera(), **kwargs)
    with OpenEXR.File(str(path)) as file:
        return dict(file.header())


def attribute_types(path):
    """Return the type of each attribute as the bytes of the file state it."""
    data, at, out = path.read_bytes(), 8, {}
    while data[at]:
        name_end = data.index(b"\0", at)
        type_end = data.index(b"\0", name_end + 1)
        out[data[at:name_end].decode()] = data[name_end + 1 : type_end].decode()
        at = type_end + 5 + struct.unpack_from("<i", data, type_end + 1)[0]
    return out


def test_exr_holds_radiance_exposure_and_depth(tmp_path):
    rng = np.random.default_rng(0)
    linear = np.exp2(rng.uniform(-10, 6, (7, 9, 3))).astype(np.float32)
    depth, alpha = np.full((7, 9), 4.0, np.float32), np.full((7, 9), 0.5, np.float32)
    path = tmp_path / "a.exr"
    taken = DisplayTransform(2.0, 2.1, PhotometryConfig())
    write_exr(path, linear, depth=depth, alpha=alpha, taken=taken)
    back, header = read_exr(path)
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


def test_world_to_ndc_puts_points_where_the_camera_sees_them(tmp_path):
    header, cam = written(tmp_path / "a.exr"), camera()
    viewmat, K = np.asarray(cam.viewmat, float), np.asarray(cam.K, float)
    for local in ([0.3, -0.2, 2.0], [-1.0, 0.8, 5.0], [0.0, 0.0, 1.0]):
        world = viewmat[:3, :3].T @ (np.array(local) - viewmat[:3, 3])
        u, v, w = K @ local
        # Imath: a row vector times the matrix, divided by its last component.
        x, y, _, weight = np.append(world, 1.0) @ header["worldToNDC"].astype(float)
        np.testing.assert_allclose(
            [x / weight, y / weight], [u / w / WIDTH, v / w / HEIGHT], atol=1e-5
        )
    # The principal point is 41 pixels from the left and 37 from the top: y points down.
    centre = viewmat[:3, :3].T @ (np.array([0, 0, 3.0]) - viewmat[:3, 3])
    x, y, _, weight = np.append(centre, 1.0) @ header["worldToNDC"].astype(float)
    np.testing.assert_allclose([x / weight, y / weight], [41 / 90, 37 / 70], atol=1e-5)


def test_world_to_camera_is_left_handed_with_y_up(tmp_path):
    header, viewmat = written(tmp_path / "a.exr"), np.asarray(camera().viewmat, float)
    matrix = header["worldToCamera"].astype(float)
    right_down_forward = np.array([0.3, 0.2, 2.0])
    world = viewmat[:3, :3].T @ (right_down_forward - viewmat[:3, 3])
    np.testing.assert_allclose(np.append(world, 1.0) @ matrix, [0.3, -0.2, 2.0, 1.0], atol=1e-5)
    assert np.linalg.det(matrix[:3, :3]) == pytest.approx(-1.0)
    np.testing.assert_allclose(header["p2gsViewmat"], viewmat, atol=1e-6)
    np.testing.assert_allclose(header["p2gsIntrinsics"], camera().K)


def test_the_screen_window_bounds_the_image_at_distance_1(tmp_path):
    header = written(tmp_path / "a.exr")
    width, (x, y) = header["screenWindowWidth"], header["screenWindowCenter"]
    left, right = x - width / 2, x + width / 2
    assert left == pytest.approx(-41 / 80)
    assert right == pytest.approx((90 - 41) / 80)
    assert y == pytest.approx((37 - (70 - 37)) / 2 / 84), "there is more image above the axis"


def test_exif_goes_into_the_attributes_of_its_own(tmp_path):
    shot = ExifSettings(time=1 / 60, aperture=2.8, iso=None, taken="2010:10:12 14:43:07")
    header = written(tmp_path / "a.exr", shot=shot)
    assert header["expTime"] == pytest.approx(1 / 60)
    assert header["aperture"] == pytest.approx(2.8)
    assert header["capDate"] == "2010:10:12 14:43:07"
    assert "isoSpeed" not in header
    assert not {"expTime", "aperture", "capDate"} & set(written(tmp_path / "b.exr"))


def test_attributes_have_the_standard_types(tmp_path):
    path = tmp_path / "a.exr"
    taken = DisplayTransform(1.0, 2.2, PhotometryConfig())
    written(path, shot=ExifSettings(0.1, 2.0, 100.0, "2010:10:12 14:43:07"), taken=taken)
    expected = {
        "chromaticities": "chromaticities",
        "adoptedNeutral": "v2f",
        "worldToCamera": "m44f",
        "worldToNDC": "m44f",
        "screenWindowCenter": "v2f",
        "screenWindowWidth": "float",
        "expTime": "float",
        "aperture": "float",
        "isoSpeed": "float",
        "capDate": "string",
        "comments": "string",
        "p2gsExposure": "float",
        "p2gsViewmat": "m44f",
        "p2gsIntrinsics": "m33f",
    }
    found = attribute_types(path)
    assert {name: found[name] for name in expected} == expected


def test_the_header_holds_white_balance_and_vignetting(tmp_path):
    linear, path = np.ones((4, 6, 3), np.float32), tmp_path / "a.exr"
    for rows in (((-0.3, 0.1, 0.0),), ((-0.3, 0.1, 0.0), (-0.2, 0.0, 0.0), (-0.1, 0.0, 0.05))):
        cfg = PhotometryConfig(cameras=(CameraFormation("a"), CameraFormation("b", rows)))
        balance = (0.2, -0.05, -0.15)
        taken = DisplayTransform(1.0, 2.2, cfg, white_balance=balance, camera=1)
        write_exr(path, linear, taken=taken)
        header = read_exr(path)[1]
        np.testing.assert_allclose(header["p2gsWhiteBalance"], np.exp(balance), rtol=1e-6)
        for name, row in zip(
            ("Red", "Green", "Blue"), rows if len(rows) == 3 else rows * 3, strict=True
        ):
            np.testing.assert_allclose(header[f"p2gsVignetting{name}"], row, rtol=1e-6)
    write_exr(path, linear, taken=taken.without_place())
    assert "p2gsVignettingRed" not in read_exr(path)[1]
