"""A bound that is given holds from the first step: more seeds than that are thinned."""

from tiny_scene import make_scene

import p2gs_jax
from p2gs_jax.core.progress import Silent
from p2gs_jax.jobs.configs import with_fields
from p2gs_jax.pipeline.prepare import load, prepare

FIELDS = {
    "render.sh_degree": 0,
    "photometry.select": False,
    "photometry.start": "random",
    "densify.max_gaussians": 40,
}


def test_more_seeds_than_the_bound_are_thinned_and_it_is_said(tmp_path):
    scene = make_scene(tmp_path / "scene")
    cfg = with_fields(p2gs_jax.preset("robust"), {**FIELDS, "init.shell": "on"})
    read = load(scene, tmp_path / "run", cfg, Silent())
    assert len(read.points) > 40
    prepared = prepare(read, cfg, Silent())
    assert prepared.params.gaussians.capacity == 40
    assert any("seed points were thinned to 40 (--gaussians)" in n for n in prepared.notes)
