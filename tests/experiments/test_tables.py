"""The tables of experiments/: what their cells say, without fitting anything."""

import json
from pathlib import Path

import at_size
import pytest
import tables
import towns

from p2gs_jax.presets import preset


def metrics(level: float, **extra):
    """Return a metrics.json whose PSNRs are `level`, novel ones a decibel lower."""
    here, there = {"psnr": level, "ssim": 0.9}, {"psnr": level - 1, "ssim": 0.8}
    return {
        "train": {**here, "averaged": here},
        "test": {"averaged": there, "exposure_fitted": there},
        "reference": {"scale_aligned": {**here, "train": here, "test": there}},
        "consistency": {
            k: dict.fromkeys(tables.STEADINESS, 0.1) for k in ("averaged", "photographs")
        },
        "counts": {"gaussians": 1000},
        "seconds": {"optimisation": 3.0},
        "ev": 0.004,
        **extra,
    }


def runs_of(wanted, level=lambda name, std, town: 20.0):
    keys = [(n, s, t) for s, names in wanted.items() for n in names for t in (0, 1)]
    found = {key: metrics(level(*key)) for key in keys}
    return towns.Runs(found, dict.fromkeys(found, Path("run")), ())


def test_means_are_over_towns_and_missing_values_are_not_invented():
    runs = runs_of({4.0: ["a"]}, lambda name, std, town: 20.0 + 2 * town)
    assert runs.mean("a", 4.0, "train", "psnr") == 21.0
    assert towns.number(runs.mean("a", 4.0, "train", "lpips"), 3) == "n/a"
    assert towns.number(runs.mean("b", 4.0, "train", "psnr"), 2) == "n/a"


def test_cells_are_means_of_their_own_method_and_iso():
    robust, plain = "robust (ours)", "3DGS"
    runs = runs_of({0.0: [robust], 4.0: [robust, plain]}, lambda name, std, town: 20.0 + std + town)
    columns = (("PSNR", ("train", "psnr"), 2), ("LPIPS", ("train", "lpips"), 3), towns.EV_ERROR)
    assert runs.cells(robust, 4.0, columns) == ["24.50", "n/a", "0.0040"]
    assert runs.cells(robust, 0.0, columns[:1]) == ["20.50"]
    assert towns.titles(columns) == ("PSNR", "LPIPS", "EV error")
    assert runs.ev_error(robust, 4.0) == "0.0040"
    assert runs.ev_error(robust, 0.0) == runs.ev_error(plain, 4.0) == ""


def test_losses_between_spreads_of_iso():
    loss = {0.0: 0.0, 2.0: 1.5, 4.0: 4.0}
    runs = runs_of(tables.iso_methods(), lambda name, std, town: 25.0 - loss[std])
    for row in tables.changes(runs):
        assert row[1:7] == ["-2.50"] * 4 + ["-4.00"] * 2
    printed = {row[0]: row[7] for row in tables.changes(runs)}
    assert printed["P2GS as printed"] == "-0.85 / -0.95"  # as the paper's table has it


def test_every_table_has_a_cell_for_every_column():
    runs = runs_of(tables.iso_methods())
    texts = [
        tables.iso(runs),
        tables.reconstruction(runs, {"3DGS": 12.0}),
        tables.novel_views(runs),
        tables.ablation(runs_of({4.0: tables.ablations()})),
        tables.ladders(runs_of({4.0: tables.ladder_configs(100)})),
    ]
    for text in texts:
        for block in text.split("\n\n"):
            rows = [line for line in block.splitlines() if line.startswith("|")]
            assert len({row.count("|") for row in rows}) <= 1
    assert texts[0].count("robust (ours)") == 4  # three spreads of ISO, and the changes
    assert tables.plot_iso(runs).axes


def test_every_variant_differs_from_all_others():
    for variants in (
        tables.ablations(),
        {k: v for k, v in towns.methods().items()},
    ):
        assert len(set(variants.values())) == len(variants)


def test_ladders_vary_one_thing_at_a_time():
    configs = tables.ladder_configs(100)
    assert configs["model: chosen"] == preset("robust")
    assert configs["SH degree 1"].render.sh_degree == 1
    assert configs["Gaussians: 160"].densify.max_gaussians == 160
    assert len({c for n, c in configs.items() if n.startswith("model")}) == 7


def test_the_budget_is_the_same_for_all():
    o = towns.Options(Path("."), towns.QUICK, 1, "w.npz", "")
    for cfg in towns.methods().values():
        under = towns.budgeted(cfg, o)
        assert under.train.steps == towns.QUICK.steps
        assert under.densify.max_gaussians == towns.QUICK.gaussians
        assert under.evaluation.lpips_weights == "w.npz"


def test_a_table_says_where_it_comes_from(tmp_path):
    o = towns.Options(tmp_path, towns.QUICK, 1, None, "python experiments/x.py --quick")
    runs = towns.Runs({("a", 4.0, 0): metrics(20.0)}, {("a", 4.0, 0): Path("r")}, ("b: no light",))
    towns.write(o, "x", "| t |\n", runs, 0.0)
    text = (tmp_path / o.protocol.name / "x.md").read_text()
    assert "python experiments/x.py --quick" in text
    assert "b: no light" in text
    saved = json.loads((tmp_path / o.protocol.name / "x.json").read_text())
    assert saved["stamp"]["protocol"]["steps"] == towns.QUICK.steps
    assert saved["rows"][0]["train"]["psnr"] == 20.0


@pytest.mark.parametrize("argv", [["--steps", "many"], ["--towns"]])
def test_wrong_options_end_with_two(argv):
    with pytest.raises(SystemExit) as stop:
        towns.options("x", "x", argv)
    assert stop.value.code == 2


def test_rows_at_size_are_sorted_and_exposures_are_only_said_where_there_are_some():
    key = at_size.Key(at_size.BENCHMARK, "ISO std 4", "3dgs", 7000)
    rest = {"gaussians": 1000, "seconds": 60, "commit": "abc"}
    radiance = {"radiance": {"test": {"mu_law_psnr": 31.0}}}

    def row(level, ev, linear):
        return {"figures": at_size.figures(metrics(level, **radiance), ev, linear), **rest}

    rows = {
        key: row(20.0, None, False),
        key._replace(method="robust"): row(25.0, 0.01, True),
        key._replace(scene="ISO-Const"): row(22.0, None, False),
        key._replace(scene=at_size.DUSK): row(15.0, None, False),
    }
    lines = [line for line in at_size.to_markdown(rows).splitlines() if line.startswith("| ")]
    assert [line.split(" | ")[:2] for line in lines[1:]] == [
        ["| robust (ours)", "ISO std 4"],
        ["| 3DGS", "ISO-Const"],
        ["| 3DGS", "ISO std 4"],
        ["| 3DGS", "dusk, 6 stops"],
    ]
    assert (
        "| 25.00 | 24.00 | 25.00 | 24.00 | 0.800 | 0.0100 | 31.00 | 1000 | 60 | abc |" in lines[1]
    )
    assert "| n/a | n/a | 1000 |" in lines[2]
    assert set(at_size.ORDER) <= set(at_size.NAMES)


def test_corrections_at_size_take_rates_of_their_own_but_for_dusk():
    key = at_size.Key(at_size.BENCHMARK, "ISO std 4", "3dgs_affine", 7000)
    plain = ("--preset", "3dgs_affine", "--steps", "7000")
    assert at_size.options_of(key)[:6] == (*plain, "--optimizer.appearance", "0.003")
    assert at_size.options_of(key._replace(scene=at_size.DUSK)) == plain
