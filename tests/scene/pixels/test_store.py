"""What a store gives of photographs: values, masks, sizes, undistortion; its bound and threads."""

from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest
from scene.helpers import make_view, refused

from p2gs_jax.config import DataConfig
from p2gs_jax.scene import ImageStore, camera_at, size_at
from p2gs_jax.types import Distortion

RNG = np.random.default_rng(0)


def noise(*shape, dtype=np.uint8):
    return RNG.integers(0, np.iinfo(dtype).max, (48, 64, *shape), dtype=dtype, endpoint=True)


def store_of(*views, **options):
    return ImageStore(views, DataConfig(**options))


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("channels", [(), (3,), (4,)])
def test_rgb_order_exact_values_grey_and_alpha(tmp_path, dtype, channels):
    raw, top = noise(*channels, dtype=dtype), np.float32(np.iinfo(dtype).max)
    ldr, mask = store_of(make_view(tmp_path / "a.png", raw)).get(0)
    assert ldr.dtype == mask.dtype == np.float32
    colours = raw[..., 2::-1] if channels else np.repeat(raw[..., None], 3, 2)
    assert np.array_equal(ldr, colours.astype(np.float32) / top)
    opaque = raw[..., 3] >= top / 2 if channels == (4,) else np.ones((48, 64))
    assert np.array_equal(mask, opaque)


def test_sizes_and_intrinsics(tmp_path):
    view = make_view(tmp_path / "a.png", size=(1000, 751))
    assert size_at(view, None) == size_at(view, 2000) == (1000, 751)
    assert size_at(view, 500, 2) == (250, 188)
    assert size_at(view, None, 4000) == (1, 1)
    K, w, h = camera_at(view, 500, 2)
    assert K.dtype == np.float32
    viewmat, K_store, *size = store_of(view, max_width=500).camera(0, 2)
    assert size == [w, h]
    assert np.array_equal(K_store, K)
    assert np.array_equal(viewmat, np.eye(4))
    # The image's corners stay its corners.
    assert (K[0, 2] / w, K[1, 2] / h) == pytest.approx((0.5, 0.5))
    assert (K[0, 0] / w, K[1, 1] / h) == pytest.approx((60 / 1000, 60 / 751))


def test_shrinking_averages_and_masks_conservatively(tmp_path):
    bgr, mask = noise(3), np.full((48, 64), 255, np.uint8)
    mask[5, 9] = 0
    cv2.imwrite(str(tmp_path / "m.png"), mask)
    view = make_view(tmp_path / "a.png", bgr, mask_path=tmp_path / "m.png")
    ldr, valid = store_of(view).get(0, 4)
    expected = bgr[..., ::-1].reshape(12, 4, 16, 4, 3).mean((1, 3)) / 255
    assert np.allclose(ldr, expected, atol=0.6 / 65535)
    assert valid[1, 2] == 0.0
    assert valid.sum() == valid.size - 1


def _pattern(x, y):
    return 0.5 + 0.4 * np.sin(x / 7.0) * np.cos(y / 9.0)


@pytest.mark.parametrize("k1", [-0.15, 0.2])
def test_undistortion_puts_pixels_where_the_pinhole_expects_them(tmp_path, k1):
    """A scene painted in undistorted coordinates, photographed with distortion, comes back."""
    w, h, f = 320, 240, 300.0
    lens = Distortion((k1, 0.05, 0.002, -0.001))
    K, exactly = np.array([[f, 0, w / 2], [0, f, h / 2], [0, 0, 1]]), (1, 200, 0)
    centres = np.stack(np.meshgrid(np.arange(w) + 0.5, np.arange(h) + 0.5), -1)
    points, c = centres.reshape(-1, 1, 2), np.array(lens.coefficients)
    rays = cv2.undistortPoints(points, K, c, P=K, criteria=exactly).reshape(h, w, 2)
    image = np.round(_pattern(rays[..., 0], rays[..., 1]) * 65535).astype(np.uint16)
    view = make_view(tmp_path / "a.png", image, f=f, distortion=lens)
    ldr, mask = store_of(view).get(0)
    truth = _pattern(centres[..., 0], centres[..., 1])
    inside = mask > 0
    assert np.abs(ldr[..., 0] - truth)[inside].max() < 3e-3  # half a pixel would be 3e-2
    if k1 > 0:
        assert 0.5 < inside.mean() < 1.0  # corners lie outside the photograph


def test_cache_is_bounded_and_reused(tmp_path):
    image = np.zeros((512, 512, 3), np.uint8)  # 1 MiB with its mask
    views = [make_view(tmp_path / f"{i}.png", image + i) for i in range(6)]
    store = store_of(*views, cache_mb=3)
    for i in range(6):
        assert store.get(i)[0].max() == np.float32(i / 255)
        assert store.cached_bytes <= 3 * 2**20
    for view in views[3:]:
        view.image_path.unlink()
    for i in (3, 4, 5):
        store.get(i)
    views[0].image_path.unlink()
    with refused(r"cannot read .*0.png"):
        store.get(0)
    tight = store_of(*views, cache_mb=0)
    tight.get(1)
    tight.get(2)
    assert tight.cached_bytes == 2**20


def test_prefetch_from_many_threads(tmp_path):
    views = [make_view(tmp_path / f"{i}.png", np.full((64, 64), i, np.uint8)) for i in range(20)]
    store = store_of(*views, cache_mb=1)

    def work(seed):
        rng = np.random.default_rng(seed)
        for i in map(int, rng.integers(0, 20, 100)):
            store.prefetch(int(rng.integers(0, 20)), float(rng.integers(1, 3)))
            assert store.get(i)[0].max() == np.float32(i / 255)

    with ThreadPoolExecutor(4) as threads:
        list(threads.map(work, range(4)))
    store.close()
    assert store.cached_bytes == 0
    gone = store_of(make_view(tmp_path / "gone.png"))
    gone.prefetch(0)
    with refused(r"gone.png"):
        gone.get(0)


@pytest.mark.parametrize("name", ["a.png", "a.jpg"])
def test_truncated_image_is_refused_not_filled_with_grey(tmp_path, name):
    view = make_view(tmp_path / name, noise(3))
    data = view.image_path.read_bytes()
    view.image_path.write_bytes(data[: len(data) * 2 // 3])
    with refused(f"cannot decode .*{name}"):
        store_of(view).get(0)


def test_changed_size_and_floats_are_refused(tmp_path):
    view = make_view(tmp_path / "a.png", noise())
    cv2.imwrite(str(view.image_path), np.zeros((24, 32), np.uint8))
    with refused("32x24 pixels, but was 64x48"):
        store_of(view).get(0)
    view = make_view(tmp_path / "a.tiff", np.zeros((48, 64, 3), np.float32))
    with refused(r"a.tiff has float32 pixels"):
        store_of(view).get(0)
