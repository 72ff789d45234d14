"""Dense starts: depths of textured planes, refused matches, and seeds drawn from the depths."""

import dataclasses

import cv2
import numpy as np
import pytest
from scene.helpers import make_view

from p2gs_jax import Photometry, Scene, preset
from p2gs_jax.config import DataConfig, DensifyConfig, FitConfig, PhotometryConfig
from p2gs_jax.core.numerics import srgb_encode
from p2gs_jax.gaussians import matching
from p2gs_jax.gaussians.dense import MATCH_SIDE, coverage_of, dense_limit, dense_seeds, wants_dense
from p2gs_jax.gaussians.flow import Flows, depth_map
from p2gs_jax.gaussians.population import Coverage
from p2gs_jax.photometry.observations import Observations
from p2gs_jax.scene.pixels.store import ImageStore

WIDTH, HEIGHT, FOCAL = 192, 144, 180.0
CENTERS = np.array([[0, 0, 0], [0.4, 0, 0], [-0.4, 0.1, 0], [0.1, 0.4, 0], [0, -0.4, 0.1]])
Y, X = np.mgrid[:HEIGHT, :WIDTH] + 0.5
RAYS = np.stack([(X - WIDTH / 2) / FOCAL, (Y - HEIGHT / 2) / FOCAL], -1)
BACK, FRONT = 5.0, 4.0
# The foreground square, scene units.
SQUARE = 0.8
NONE = np.zeros((0, 3))


def texture(seed, size=512):
    noise = np.random.default_rng(seed).random((size, size, 3)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0) + cv2.GaussianBlur(noise, (0, 0), 6.0)
    smooth = (smooth - smooth.mean()) / smooth.std()
    return np.clip(0.2 + 0.07 * smooth, 0.01, 1)


def look_up(image, x, y):
    """Return the texture at scene coordinates, 40 texels a unit."""
    right, down = (((v * 40 + 256) % 511).astype(np.float32) for v in (x, y))
    return cv2.remap(image, right, down, cv2.INTER_LINEAR)


def render(center, square, tilt, paint):
    """Return radiance and depth of a plane z = BACK + tilt x, and of a square in front of it."""
    z = (BACK + tilt * center[0] - center[2]) / (1 - tilt * RAYS[..., 0])
    place = center[:2] + RAYS * z[..., None]
    image = look_up(paint[0], place[..., 0], place[..., 1])
    if square:
        place = center[:2] + RAYS * (FRONT - center[2])
        hit = (np.abs(place) < SQUARE).all(-1)
        image[hit] = look_up(paint[1], place[..., 0], place[..., 1])[hit]
        z = np.where(hit, FRONT - center[2], z)
    return image, z


class World:
    """A textured plane on disk and its true depths; views in `spoil` show other textures."""

    def __init__(self, path, *, square=False, tilt=0.0, exposures=None, spoil=(), change=None):
        path.mkdir(exist_ok=True)
        exposures = np.ones(len(CENTERS)) if exposures is None else np.asarray(exposures)
        paint, other = (texture(1), texture(2)), (texture(3), texture(4))
        views, self.depths = [], []
        for k, center in enumerate(CENTERS):
            linear, z = render(center, square, tilt, other if k in spoil else paint)
            if change is not None:
                linear = change(k, linear)
            shown = srgb_encode(np.clip(linear * exposures[k], 0, 1).astype(np.float32))
            codes = np.rint(255 * shown[..., ::-1]).astype(np.uint8)
            views.append(make_view(path / f"{k}.png", codes, FOCAL, at=center))
            self.depths.append(z)
        x, y = (g.ravel() for g in np.meshgrid(np.linspace(-2, 2, 5), np.linspace(-1.5, 1.5, 4)))
        points = np.stack([x, y, BACK + tilt * x], 1).astype(np.float32)
        colors = np.full((len(points), 3), 128, np.uint8)
        self.scene = Scene(path, "test", tuple(views), points, colors)
        self.store = ImageStore(views, DataConfig())
        photometry = Photometry(np.log(exposures), np.zeros(len(views)))
        self.tones = matching.Tones(photometry, PhotometryConfig())

    def depth(self, row=0):
        cfg = FitConfig().loss
        side, tones = MATCH_SIDE, self.tones
        images = matching.MatchImages(
            self.scene, self.store, tones, side, cfg.black, cfg.saturation
        )
        flows = Flows(images, self.scene.points, matching.visibility(self.scene, 0))
        found = depth_map(flows, row, [k for k in range(len(CENTERS)) if k != row])
        return found, np.abs(1 / np.maximum(found.inverse, 1e-9) / self.depths[row] - 1)

    def seeds(self, limit=100_000, existing=NONE):
        inputs = self.scene, self.store, self.tones, self.tones, FitConfig()
        return dense_seeds(*inputs, existing=existing, limit=limit)


@pytest.fixture(scope="module")
def plane(tmp_path_factory):
    return World(tmp_path_factory.mktemp("plane"), tilt=0.5)


def test_depths_of_a_slanted_plane_are_right(plane):
    found, error = plane.depth()
    assert found.valid.mean() > 0.7
    assert np.quantile(error[found.valid], 0.95) < 0.01
    assert found.flat[found.valid].mean() > 0.95


def test_depths_of_hidden_surfaces_are_right_or_refused(tmp_path):
    world = World(tmp_path, square=True)
    found, error = world.depth()
    assert found.valid.mean() > 0.5
    assert (error[found.valid] > 0.05).mean() < 0.02
    # Both surfaces are found.
    front = world.depths[0] < 0.5 * (BACK + FRONT)
    assert found.valid[front].mean() > 0.5
    assert found.valid[~front].mean() > 0.4


def test_wrong_matches_are_refused(tmp_path):
    one = World(tmp_path, spoil=(1,))
    found, error = one.depth()
    assert found.valid.mean() > 0.5
    assert np.quantile(error[found.valid], 0.95) < 0.01
    # The photograph of another scene has no depths.
    assert one.depth(1)[0].valid.mean() < 0.01


def test_exposures_do_not_matter_once_they_are_solved(tmp_path):
    same = World(tmp_path / "even")
    other = World(tmp_path / "mixed", exposures=[1.0, 0.5, 2.0, 0.5, 2.0])
    images = matching.MatchImages(other.scene, other.store, other.tones, MATCH_SIDE, 0.02, 0.98)
    first, second = matching.at_common_exposure(images[0], images[2])
    assert abs(float(first.mean()) - float(second.mean())) < 6
    assert first.std() > 20
    a, b = same.depth()[0], other.depth()[0]
    assert b.valid.mean() > 0.9 * a.valid.mean()
    both = a.valid & b.valid
    assert np.quantile(np.abs(a.inverse[both] / b.inverse[both] - 1), 0.95) < 0.01
    # Seeds have the world's radiance, 0.2, in the gauge of the exposures.
    for seeds in (same.seeds(), other.seeds()):
        assert abs(np.median(seeds.radiance) / 0.2 - 1) < 0.1
    # Without solved exposures their colours seem to differ, and matches are refused.
    blind = World(tmp_path / "mixed", exposures=[1.0, 0.25, 4.0, 0.25, 4.0])
    blind.tones = same.tones
    assert blind.depth()[0].valid.mean() < 0.9 * b.valid.mean()


def test_clipped_pixels_carry_no_seed(tmp_path):
    def lamp(k, linear):
        place = CENTERS[k, :2] + RAYS * (BACK - CENTERS[k, 2])
        linear[(np.abs(place) < 0.5).all(-1)] = 3.0
        return linear

    points = World(tmp_path, change=lamp).seeds().points
    in_lamp = (np.abs(points[:, :2]) < 0.5).all(1) & (np.abs(points[:, 2] - BACK) < 0.5)
    assert len(points) > 200
    assert not in_lamp.any()


def test_seeds_are_bounded_spread_and_repeatable(plane):
    many, few = plane.seeds(), plane.seeds(limit=150)
    for field in ("points", "radiance", "scales", "quats"):
        np.testing.assert_array_equal(getattr(few, field), getattr(plane.seeds(limit=150), field))
    assert len(many.points) > 1000
    assert 100 <= len(few.points) <= 150
    assert np.quantile(np.abs(few.points[:, 2] - BACK - 0.5 * few.points[:, 0]), 0.95) < 0.1
    for low, high in ((-2, -0.7), (-0.7, 0.7), (0.7, 2)):
        assert ((few.points[:, 0] > low) & (few.points[:, 0] < high)).sum() > 15
    # Fewer seeds stand for larger patches.
    assert np.median(few.scales[:, 1]) > 2 * np.median(many.scales[:, 1])
    assert len(plane.seeds(limit=0).points) == 0


def test_seeds_lie_flat_on_their_surface(plane):
    seeds = plane.seeds(limit=500)
    w, x, y, z = seeds.quats.T
    third = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], 1)
    normal = np.array([-0.5, 0, 1]) / np.hypot(0.5, 1)
    assert np.quantile(np.abs(third @ normal), 0.1) > 0.99
    assert np.median(seeds.scales[:, 2] / seeds.scales[:, 1]) < 0.5


def test_existing_seeds_have_precedence(plane):
    x, y = (g.ravel() for g in np.meshgrid(np.linspace(-2.5, 0, 40), np.linspace(-2, 2, 60)))
    existing = np.stack([x, y, BACK + 0.5 * x], 1)
    left = plane.seeds(limit=400, existing=existing).points[:, 0] < -0.1
    assert (~left).sum() > 150
    assert left.sum() < 0.05 * len(left)
    # Existing seeds far behind do not count.
    behind = plane.seeds(limit=400, existing=existing * [1, 1, 3])
    assert (behind.points[:, 0] < -0.1).sum() > 100


def test_neighbours_prefer_similar_exposures(plane):
    scene, even = plane.scene, np.zeros(len(CENTERS))
    near = matching.neighbours(scene, matching.visibility(scene, 0), even, 2)
    assert all(len(n) == 2 and k not in n for k, n in enumerate(near))
    # The first two only differ from the rest in their exposure.
    near = matching.neighbours(
        scene, matching.visibility(scene, 0), np.array([3.0, 3.0, -3.0, -3.0, -3.0]), 2
    )
    assert near[0][0] == 1
    assert near[1][0] == 0


def test_rough_tones_find_the_factors():
    rng = np.random.default_rng(0)
    log_exposures = rng.normal(0, 0.4, 8)
    radiance = rng.uniform(0.1, 0.4, (300, 3))
    views, points = (g.ravel() for g in np.meshgrid(np.arange(8), np.arange(300)))
    colors = srgb_encode(np.minimum(radiance[points] * np.exp(log_exposures[views])[:, None], 1))
    tracks = Observations(views, points, colors, 0 * colors, 8, 300, np.zeros(8, int))
    found = matching.rough_tones(tracks, 8).photometry.log_exposures
    np.testing.assert_allclose(found, log_exposures - log_exposures.mean(), atol=0.05)
    assert not matching.rough_tones(None, 8).photometry.log_exposures.any()


def with_seeds(cfg, **changes):
    return dataclasses.replace(cfg, init=dataclasses.replace(cfg.init, **changes))


def test_dense_seeds_leave_room_to_grow():
    cfg = FitConfig()
    bounded = dataclasses.replace(cfg, densify=DensifyConfig(max_gaussians=1000))
    whole, quarter = Coverage(640 * 480, 1.0), Coverage(640 * 480, 0.25)
    assert dense_limit(bounded, 100, whole) == 500
    assert dense_limit(bounded, 2000, whole) == 0
    assert dense_limit(with_seeds(bounded, dense_points=5000), 100, whole) == 900
    assert dense_limit(with_seeds(cfg, dense_points=50_000), 100, whole) == 50_000
    assert 0 < dense_limit(cfg, 100, whole) < 640 * 480 / 10
    assert dense_limit(cfg, 0, quarter) == 4 * dense_limit(cfg, 0, whole) > 0


def test_dense_starts_are_chosen_where_seeds_are_few(plane):
    scene, coverage = plane.scene, coverage_of(plane.scene, None)
    many = {name: np.repeat(getattr(scene, name), 200, 0) for name in ("points", "point_colors")}
    lidar = dataclasses.replace(scene, **many)
    for candidate, cfg, wanted in (
        (scene, FitConfig(), True),
        (scene, preset("3dgs"), True),
        (scene, preset("paper"), False),
        (scene, with_seeds(FitConfig(), dense="off"), False),
        (lidar, FitConfig(), False),
    ):
        assert wants_dense(candidate, coverage, cfg) == wanted
