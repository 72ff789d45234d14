"""A foreign program can render from `linear.ply` and `linear.json` alone."""

import json

import jax.numpy as jnp
import numpy as np
import pytest
from plyfile import PlyData
from splats import random_splats
from tiny_scene import noise_scene

from p2gs_jax.config import DataConfig, FitConfig, PhotometryConfig, RenderConfig
from p2gs_jax.core.atomic import write_json
from p2gs_jax.export.sidecar import linear_sidecar
from p2gs_jax.formats.ply import write_radiance
from p2gs_jax.photometry.display import DisplayTransform, develop
from p2gs_jax.photometry.response import FREE, KNOTS
from p2gs_jax.render.harmonics import evaluate, radiance_activation
from p2gs_jax.scene.pixels.store import ImageStore

ROW = {"camera": "0", "exif_ev": None}
VIEWS = [
    {"image": "a.png", "exposure": 2.0, "exposure_ev": 1.0, "gamma": 2.4, "split": "train"},
    {"image": "b.png", "exposure": None, "exposure_ev": None, "gamma": None, "split": "test"},
]
SPLINE = tuple(np.where(np.isin(np.arange(len(KNOTS)), FREE), 0.05, 0.0))


def sidecar(folder, *, activation="exp", degree=3, **photometry):
    """Write both files; return the JSON as read and the Gaussians."""
    g = random_splats(degree=degree)
    scene, tone = noise_scene(folder, ("a.png",), ("b.png",)), PhotometryConfig(**photometry)
    cfg = FitConfig(render=RenderConfig(radiance=activation), photometry=tone)
    known = {
        "model": "view_exposure_gamma",
        "curve": {"name": tone.curve, "pivot": tone.pivot, "spline": None},
        "gauge": "in words",
        "mean": {"exposure": 2.0, "exposure_geometric": 2.0, "gamma": 2.4},
        "views": [{**ROW, **v, "exposure_fitted": 1.5} for v in VIEWS],
    }
    store = ImageStore(scene.views, DataConfig(max_width=20))
    write_json(folder / "linear.json", linear_sidecar(g, cfg, scene, store, known))
    write_radiance(folder / "linear.ply", g, np.ones(50, bool), activation=activation)
    return json.loads((folder / "linear.json").read_text()), g, cfg


@pytest.mark.parametrize("activation", ["exp", "linear"])
@pytest.mark.parametrize("degree", [0, 2, 3])
def test_radiance_follows_from_the_two_files(tmp_path, activation, degree):
    said, g, _ = sidecar(tmp_path, activation=activation, degree=degree)
    vertex = PlyData.read(str(tmp_path / said["ply"]))["vertex"]
    x, y, z = direction = (0.36, 0.48, -0.8)
    K = said["spherical_harmonics"]["coefficients"]
    assert K == (said["spherical_harmonics"]["degree"] + 1) ** 2 == (degree + 1) ** 2
    basis = [eval(text, {"x": x, "y": y, "z": z}) for text in said["spherical_harmonics"]["basis"]]
    radiance = np.empty((said["gaussians"], 3))
    for c in range(3):
        names = [f"f_dc_{c}", *(f"f_rest_{c * (K - 1) + k - 1}" for k in range(1, K))]
        s = sum(b * vertex[name] for b, name in zip(basis, names, strict=True))
        formula = said["radiance"]["formula"].split(" of the sum")[0]
        names = {"exp": np.exp, "log": np.log, "clip": np.clip, "max": np.maximum, "s": s}
        radiance[:, c] = eval(formula.removeprefix("L = "), names)
    ours = radiance_activation(
        evaluate(g.sh, tuple(jnp.full(50, v) for v in direction)), said["radiance"]["activation"]
    )
    np.testing.assert_allclose(radiance, ours, rtol=2e-5, atol=1e-6)


@pytest.mark.parametrize(
    "options",
    [{}, {"curve": "power", "pivot": 1.0, "clamp": True}, {"curve": "spline", "spline": SPLINE}],
)
@pytest.mark.parametrize(("exposure", "gamma"), [(1.0, 2.2), (2.5, 1.9), (0.2, 2.6)])
def test_the_tone_curve_follows_from_the_table(tmp_path, options, exposure, gamma):
    said, _, cfg = sidecar(tmp_path, **options)
    tone = said["tone"]
    radiance = np.exp2(np.linspace(-10, 3, 200)).astype(np.float32)
    exposed = np.maximum(exposure * radiance, tone["exposed_limits"][0])
    if tone["exposed_limits"][1] is not None:
        exposed = np.minimum(exposed, tone["exposed_limits"][1])
    linear = tone["pivot"] * (exposed / tone["pivot"]) ** (2.2 / gamma)
    found = np.interp(np.log(linear), np.log(tone["base"]["linear"]), tone["base"]["display"])
    expected = develop(radiance, DisplayTransform(exposure, gamma, cfg.photometry))
    np.testing.assert_allclose(found, expected, atol=0.5 / 255)


def test_views_have_cameras_at_the_size_of_the_fit_and_their_exposures(tmp_path):
    said, _, _ = sidecar(tmp_path)
    a, b = said["views"]
    assert (a["image"], a["exposure"], a["gamma"]) == ("a.png", 2.0, 2.4)
    assert (b["exposure"], b["exposure_fitted"]) == (None, 1.5)
    assert (a["width"], a["height"]) == (20, 17)
    assert a["K"] == [[20, 0, 10], [0, 20, 8.5], [0, 0, 1]]
    assert said["mean"]["exposure_geometric"] == 2.0
    assert said["tone"]["correction"] is None
    said, *_ = sidecar(tmp_path, appearance="affine")
    assert said["tone"]["correction"] == {"kind": "affine", "file": "linear.appearance.npy"}
