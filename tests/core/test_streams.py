"""Every random stream has one user, and a seed draws the same numbers as in former versions."""

import re
from pathlib import Path

import jax
import numpy as np
import pytest

import p2gs_jax
from p2gs_jax.core.streams import (
    SceneStream,
    Stream,
    densification_key,
    device_seed,
    generator,
    noise_key,
    view_order,
)

PACKAGE = Path(p2gs_jax.__file__).parent
# Modules with one generator for everything: toy data, an export's order.
ALONE = ("core/streams.py", "gaussians/bake.py")


def test_every_stream_has_one_user():
    uses = {}
    for path in PACKAGE.rglob("*.py"):
        name = str(path.relative_to(PACKAGE))
        text = path.read_text(encoding="utf-8")
        if not name.startswith(ALONE):
            assert not re.search(r"default_rng|random\.key\(|SeedSequence", text), name
        if name == "core/streams.py":
            continue
        for kind, stream in re.findall(r"\b(Stream|SceneStream)\.([A-Z_]+)", text):
            uses.setdefault((kind, stream), set()).add(name)
    named = {("Stream", s.name) for s in Stream} | {("SceneStream", s.name) for s in SceneStream}
    assert set(uses) == named
    assert not {s: names for s, names in uses.items() if len(names) > 1}


def test_seeds_draw_the_numbers_of_former_versions():
    old = {Stream.PARTNER: 1, Stream.STEP_PAIRS: 2, Stream.START_EXPOSURES: 3, Stream.HELD_OUT: 7}
    old |= {Stream.COMPARED_POINTS: 5, Stream.COLOR_PAIRS: 11, Stream.SURFACE_COLORS: 17}
    old |= {Stream.SOLVED_POINTS: 19, SceneStream.ISO: 2, SceneStream.LIGHT: 5}
    for stream, number in old.items():
        for more in ((), (4,)):
            before = np.random.default_rng((9, number, *more)).random(3)
            np.testing.assert_array_equal(generator(9, stream, *more).random(3), before)
    np.testing.assert_array_equal(view_order(9, 2, 8), np.random.default_rng((9, 2)).permutation(8))


@pytest.mark.parametrize("seed", [0, 7, 2**31, 2**32 - 1, 2**32 + 5])
def test_a_traced_seed_draws_the_numbers_of_a_constant_seed(seed):
    made = set()
    for key, constant in ((noise_key, seed), (densification_key, seed + 1)):
        for step in (4, 5):
            found = jax.random.key_data(jax.jit(key)(device_seed(seed), np.int32(step)))
            known = jax.random.fold_in(jax.random.key(constant), step)
            np.testing.assert_array_equal(found, jax.random.key_data(known))
            made.add(found.tobytes())
    assert len(made) == 4, "a step and its densification have different keys"
