"""The page: its contents, Gaussians left out of a small page, and names that stay text."""

import json
import re
from dataclasses import replace

import jax
import numpy as np
import pytest

from p2gs_jax import UserError, load_run
from p2gs_jax.core.numerics import on_device
from p2gs_jax.export.page import MEGABYTE, RESERVE, page_text, write_page
from p2gs_jax.export.page_scene import embedded_photographs, page_scene
from p2gs_jax.export.page_splats import ever_drawn, fit_into, weights
from p2gs_jax.render import project
from p2gs_jax.render.tiles import rasterize_reference

HOSTILE = '</script><script>window.hacked=1</script><img src=x onerror="hacked=1">{{scene}}'


@pytest.fixture(scope="module")
def fitted(finished_run):
    return load_run(finished_run)


@pytest.fixture(scope="module")
def whole(fitted, tmp_path_factory):
    """Return the path of a page with all splats, and what `write_page` returned."""
    path = tmp_path_factory.mktemp("page") / "scene.html"
    return path, write_page(path, fitted, fitted.common_display(), size_mb=5)


def element(text, name):
    return re.search(rf'<script type="[^"]*" id="{name}">(.*?)</script>', text, re.S)[1]


def test_the_file_holds_every_visible_gaussian_states_its_error_and_loads_nothing(whole, fitted):
    path, page = whole
    assert path.stat().st_size == page.size < 5 * MEGABYTE
    assert page.splats.whole
    assert page.splats.packed.count == ever_drawn(fitted.params.gaussians, fitted.cfg.render).sum()
    scene = json.loads(element(path.read_text(), "scene"))
    assert len(scene["views"]) == len(fitted.scene.views)
    assert scene["about"][: len(page.sentences)] == list(page.sentences)
    e = np.exp2([v["ev"] for v in scene["views"]]) * scene["look"]["exposure"]
    rows = fitted.scene.train_indices
    np.testing.assert_allclose(e[list(rows)], fitted.params.photometry.exposures, rtol=1e-5)
    error, text = page.splats.error, path.read_text()
    assert error.psnr_worst > 40
    assert error.stops_median < 0.01
    assert error.stops_median <= error.stops_p99 <= error.stops_max
    assert any(f"{error.psnr_median:.1f} dB" in s for s in page.sentences)
    assert any(f"{error.stops_max:.2f}" in s for s in page.sentences)
    assert not re.search(r"https?://", text)
    assert not re.search(r'\b(src|href)="(?!data:)', text)
    assert "default-src 'none'" in text


def test_a_small_page_drops_the_least_weights_or_is_refused(whole, fitted, tmp_path):
    _, complete = whole
    size = complete.size + RESERVE - 2 * len(complete.splats.packed.data) // 3
    page = write_page(tmp_path / "s.html", fitted, fitted.common_display(), size_mb=size / MEGABYTE)
    assert page.size <= size
    assert not page.splats.whole
    assert page.splats.error.psnr_median < complete.splats.error.psnr_median
    sentence = page.sentences[0]
    assert sentence.startswith("Left out to stay within")
    assert f"{page.splats.packed.count} Gaussians remain" in sentence
    assert page.splats.dropped > 0
    assert f": the {page.splats.dropped} least visible of" in sentence
    (tmp_path / "s.html").unlink()
    for size in (0.01, (complete.size - 4 / 3 * len(complete.splats.packed.data)) / MEGABYTE):
        with pytest.raises(UserError, match=r"--size-mb|would fit"):
            write_page(tmp_path / "s.html", fitted, fitted.common_display(), size_mb=size)
    assert list(tmp_path.iterdir()) == []


def test_weights_are_sums_of_blending_weights(fitted):
    g, cfg, camera = fitted.params.gaussians, fitted.cfg.render, fitted.camera(0)
    found = weights(g, [camera], cfg)
    splats = jax.jit(project, static_argnums=3)(g, np.ones(g.capacity, bool), camera, cfg)
    one = int(np.argmax(found))
    light = on_device(np.eye(g.capacity)[one][:, None] * np.ones(3))
    reference = jax.jit(rasterize_reference, static_argnums=(2, 3, 4))
    linear, _, _ = reference(splats, light, camera.width, camera.height, cfg)
    assert found[one] == pytest.approx(float(np.asarray(linear)[..., 0].sum()), rel=0.01)


def test_gaussians_that_nobody_can_see_are_left_out_and_counted(fitted):
    g = fitted.params.gaussians
    logits = g.opacity_logits.at[0].set(-6.0)
    broken = replace(g, opacity_logits=logits, means=g.means.at[1, 0].set(np.nan))
    drawn = ever_drawn(broken, fitted.cfg.render)
    assert not drawn[0]
    assert not drawn[1]
    found = fit_into(10**9, broken, fitted.cfg.render, [], lambda shown: None)  # pyright: ignore
    assert found.unseen == (~drawn).sum() >= 2
    assert found.whole


def test_hostile_names_stay_text(fitted):
    views = tuple(replace(v, name=HOSTILE + v.name) for v in fitted.scene.views)
    named = replace(fitted, scene=replace(fitted.scene, views=views))
    text = page_text(HOSTILE, page_scene(named, fitted.common_display(), {}), b"")
    assert text.count("<script") == 4
    assert "<img" not in text
    assert json.loads(element(text, "scene"))["views"][0]["name"] == views[0].name


def test_photographs_are_embedded_only_on_request(fitted, whole):
    assert embedded_photographs(fitted, 0) == {}
    found = embedded_photographs(fitted, 2)
    assert len(found) == 2
    assert all(url.startswith("data:image/webp;base64,") for url in found.values())
    assert "data:image/webp" not in whole[0].read_text()
    views = tuple(
        replace(v, image_path=v.image_path.with_name("gone.png")) for v in fitted.scene.views
    )
    gone = replace(fitted, scene=replace(fitted.scene, views=views))
    with pytest.raises(UserError, match="missing"):
        embedded_photographs(gone, 1)


def test_export_writes_the_page_and_does_not_replace_it(finished_run, run_command, tmp_path):
    argv = ("export", finished_run, "--format", "html", "--out", tmp_path)
    for expected, word in ((0, "dB"), (2, "--overwrite")):
        status, printed = run_command(*argv)
        assert (status, word in printed) == (expected, True)
    assert (tmp_path / "scene.html").stat().st_size < 20 * MEGABYTE
