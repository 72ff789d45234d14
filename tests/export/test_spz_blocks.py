"""A population in parts: every Gaussian in one of them, neighbours together."""

import itertools
import json

import numpy as np
import pytest

from p2gs_jax.export.blocks import cut, write_blocks
from p2gs_jax.types import Gaussians


@pytest.mark.parametrize(("n", "count"), [(1000, 7), (1000, 1), (64, 64), (5, 9), (3, 3)])
def test_every_row_is_in_one_part_and_parts_are_even(n, count):
    means = np.random.default_rng(n).normal(size=(n, 3)) * [9, 1, 3]
    parts = cut(means, count)
    assert len(parts) == min(n, count)
    assert np.array_equal(np.sort(np.concatenate(parts)), np.arange(n))
    sizes = [len(part) for part in parts]
    assert max(sizes) - min(sizes) <= 1
    assert all((np.diff(part) > 0).all() for part in parts)


def test_parts_are_cut_across_the_longest_side():
    means = np.random.default_rng(0).uniform(0, 1, (4000, 3)) * [100, 1, 10]
    boxes = [(means[p].min(0), means[p].max(0)) for p in cut(means, 4)]
    for (_, high), (low, _) in itertools.pairwise(boxes):
        assert high[0] <= low[0]


def test_files_hold_all_and_positions_are_finer(tmp_path):
    pytest.importorskip("gsply", reason="the extra `spz` is not installed")
    rng = np.random.default_rng(0)
    # Half of the scene is near the origin, half far away.
    means = rng.normal(size=(400, 3)) + np.where(np.arange(400) < 200, 0, 5000)[:, None]
    shapes = ((4,), (3,), (), (4, 3))
    values = [rng.normal(size=(400, *shape)).astype(np.float32) for shape in shapes]
    g = Gaussians(means.astype(np.float32), *values)
    read, table = write_blocks(tmp_path / "blocks", g, 2)
    assert sorted(p.name for p in (tmp_path / "blocks").iterdir()) == ["000.spz", "001.spz"]
    assert [row["gaussians"] for row in table] == [200, 200]
    off = np.abs(np.asarray(read.means) - means).max(1)
    assert off[:200].max() < 2.0**-19
    assert off[200:].max() < 2.0**-9
    assert table[0]["high"][0] < table[1]["low"][0]


def test_the_command_writes_a_folder_and_a_table(finished_run, run_command, tmp_path):
    pytest.importorskip("gsply", reason="the extra `spz` is not installed")
    argv = ("export", finished_run, "--format", "spz", "--out", tmp_path, "--bake-steps", "2")
    code, said = run_command(*argv, "--spz-blocks", "3")
    assert code == 0, said
    table = json.loads((tmp_path / "display.spz.json").read_text())
    assert table["file"] == "display_blocks"
    assert sum(row["gaussians"] for row in table["blocks"]) == table["gaussians"]
    for row in table["blocks"]:
        assert (tmp_path / "display_blocks" / row["file"]).is_file()
    assert table["baking_error"]["train"]
    code, said = run_command(*argv, "--spz-blocks", "2")
    assert code == 2
    assert "exists already" in said


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--format", "splat", "--spz-blocks", "2"), "says nothing without the format spz"),
        (("--format", "spz", "--spz-blocks", "0"), "must be a number from 1 to 999"),
    ],
)
def test_senseless_blocks_are_refused(finished_run, run_command, tmp_path, options, said):
    code, text = run_command("export", finished_run, "--out", tmp_path, *options)
    assert code == 2
    assert said in text
