"""Segments of tile lists, composited separately and merged, equal one pass over the lists."""

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st

from p2gs_jax.render.rasterize_xla import merge
from p2gs_jax.render.segments import cut

TILES, MOST, UNIT, PIXELS = 6, 16, 2, 3
LENGTHS = st.lists(
    st.one_of(st.just(0), st.integers(0, 9), st.integers(0, 400)), min_size=TILES, max_size=TILES
)
GIANT = [0, 0, 4000, 0, 1, 0]

jitted_cut = jax.jit(lambda offsets: cut(offsets, MOST, UNIT))
jitted_merge = jax.jit(lambda c, segments: merge(c, segments.tiles[TILES:], segments.firsts[-1]))


def composite(colors, alphas):
    """Return the colour and the transmittance of entries from front to back."""
    color, transmittance = np.zeros(PIXELS), np.ones(PIXELS)
    for c, a in zip(colors, alphas, strict=True):
        color, transmittance = color + transmittance * a * c, transmittance * (1 - a)
    return color, transmittance


@settings(max_examples=25, deadline=None)
@given(LENGTHS, st.integers(0, 100))
@example(GIANT, 0)
def test_merged_segments_equal_one_pass(lengths, seed):
    rng = np.random.default_rng(seed)
    offsets = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int32)
    total = int(offsets[-1])
    colors = rng.uniform(0, 4, (total, PIXELS))
    alphas = rng.uniform(0, 0.1, (total, PIXELS)) * (rng.random((total, 1)) < 0.5)
    segments = jitted_cut(jnp.asarray(offsets))
    parts = [
        composite(colors[a:b], alphas[a:b])
        for a, b in zip(np.asarray(segments.starts), np.asarray(segments.ends), strict=True)
    ]
    stacked = tuple(jnp.asarray(np.stack(p), jnp.float32) for p in zip(*parts, strict=True))
    image, before = jitted_merge(stacked, segments)
    for t in range(TILES):
        whole = composite(*(a[offsets[t] : offsets[t + 1]] for a in (colors, alphas)))
        for got, expected in zip(image, whole, strict=True):
            np.testing.assert_allclose(np.asarray(got)[t], expected, rtol=1e-5, atol=1e-6)
    tiles, starts = np.asarray(segments.tiles), np.asarray(segments.starts)
    for k in range(int(segments.firsts[-1])):
        t, start = tiles[TILES + k], starts[TILES + k]
        front = composite(*(a[offsets[t] : start] for a in (colors, alphas)))
        for got, expected in zip(before, front, strict=True):
            np.testing.assert_allclose(np.asarray(got)[k], expected, rtol=1e-5, atol=1e-6)
