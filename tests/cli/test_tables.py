"""The headline that ends a fit."""

import pytest

from p2gs_jax.cli import tables


@pytest.mark.parametrize(("psnr", "viewer"), [(25.0, True), (15.6, False)])
def test_the_headline_names_the_next_command(psnr, viewer, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(tables, "has_viewer", lambda: viewer)
    test = {"exposure_fitted": {"psnr": psnr, "per_view": {"a": {}, "b": {}}}}
    metrics = {"test": test, "counts": {"gaussians": 1000}, "seconds": {}}
    tables.print_headline(metrics, tmp_path / "a run")
    printed = capsys.readouterr().out
    assert printed.startswith(f"Held out {psnr} dB over 2 views (exposures fitted), 1,000 Gaussian")
    assert ("This is low" in printed) == (psnr < tables.LOW_DB)
    assert f"p2gs-jax view '{tmp_path / 'a run'}'" in printed
    assert ("pip install" in printed) == (not viewer)
