"""Lists are longer than needed by known margins, and grow until a view fits."""

import numpy as np

from p2gs_jax.render.capacity import FEWEST_ENTRIES, SMALLEST, Room, bucket, until_it_fits
from p2gs_jax.render.visible import BLOCK


def test_buckets_are_few_and_hold_what_they_must():
    lengths = {bucket(n) for n in range(1, 200_000, 37)}
    assert len(lengths) < 20
    assert min(lengths) == SMALLEST
    for needed in (1, SMALLEST, SMALLEST + 1, 123_456):
        assert needed * 1.5 <= bucket(needed, 1.5) <= max(SMALLEST, 1.26 * 1.5 * needed)


def test_a_view_is_drawn_again_until_it_fits():
    needs, drawn = iter([30_000, 90_000, 60_000]), []

    def draw(entries):
        drawn.append(entries)
        needed = np.int32(next(needs))
        return f"{entries}", needed, needed > entries

    result, found = until_it_fits(draw, SMALLEST)
    assert drawn == [SMALLEST, bucket(30_000, 1.1), bucket(90_000, 1.1)]
    assert result == f"{found}" == f"{drawn[-1]}"


def test_room_of_a_run_foresees_growth_within_its_bound():
    now = Room.allocate(40_000, 9000, 1.0, 10**6)
    later = Room.allocate(40_000, 9000, 4.0, 10**6)
    assert now == (bucket(60_000), 3 * BLOCK)
    # Four times as many Gaussians are smaller: their lists are twice as long.
    assert later == (bucket(4 * int(9000 * 1.1 * 4.0)), 10 * BLOCK)
    assert Room.allocate(40_000, 9000, 4.0, 5000).visible == 2 * BLOCK
    assert Room.allocate(1, 1, 1.0, 100) == (bucket(FEWEST_ENTRIES), BLOCK)
    assert later.holds(now)
    assert not now.holds(later)
    # Only what was short grows.
    assert now.grown(80_000, 1) == (bucket(80_000, 1.5), now.visible)
    assert now.grown(1, 20_000) == (now.entries, bucket(20_000, 1.2))
