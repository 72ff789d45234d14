"""A fit that will not find its memory is refused before it begins, with the option that helps."""

import re
from types import SimpleNamespace

import numpy as np
import pytest
from tiny_scene import make_scene

import p2gs_jax
from p2gs_jax.errors import UserError
from p2gs_jax.gaussians.population import Coverage
from p2gs_jax.jobs.configs import with_fields
from p2gs_jax.pipeline import fit as pipeline
from p2gs_jax.pipeline import preflight as module
from p2gs_jax.pipeline.preflight import MemoryNeeded, memory_needed, require_memory
from p2gs_jax.run.checkpoint import CheckpointStore

GB = 1e9
ROBUST = p2gs_jax.preset("robust")


@pytest.fixture
def left(monkeypatch):
    """Return a function that says how much there is; of it 1 GB is held already."""
    monkeypatch.setattr(module, "resident", lambda: GB)

    def there_are(size):
        monkeypatch.setattr(module, "left_to_process", lambda: size)

    return there_are


def scene(views=4, size=(1000, 500), points=100):
    one = SimpleNamespace(width=size[0], height=size[1], size=size, name="a", image=None)
    return SimpleNamespace(views=[one] * views, points=np.zeros((points, 3)))


def test_every_part_counts(monkeypatch):
    monkeypatch.setattr(module, "size_at", lambda view, width: view.size)
    coverage = Coverage(500_000, 1.0)

    def parts(cfg=None, **more):
        cfg = with_fields(ROBUST, {"densify.max_gaussians": 50_000} | (cfg or {}))
        return memory_needed(scene(**more), cfg, coverage)

    found = parts()
    assert found.population == 50_000
    assert found.total == sum(found[:4])
    assert parts({"densify.max_gaussians": 100_000}).gaussians == 2 * found.gaussians
    assert parts(views=8).photographs == 2 * found.photographs
    assert parts({"data.cache_mb": 1}).photographs == 2**20
    harmonics = parts({"render.sh_degree": 3}).gaussians / parts({"render.sh_degree": 0}).gaussians
    assert harmonics == (11 + 48) / (11 + 3)
    monkeypatch.setattr(module.jax, "default_backend", lambda: "gpu")
    on_gpu = parts()
    assert (on_gpu.gaussians, on_gpu.view) == (0, 0)
    assert on_gpu.photographs == found.photographs


@pytest.mark.parametrize(
    ("needed", "room", "option", "most"),
    [
        (MemoryNeeded(GB, 8 * GB, GB, GB, 4_000_000), 3, "--gaussians", 500_000),
        (MemoryNeeded(GB, GB, 4 * GB, GB, 500_000), 3, "--data.cache-mb", 2**20),
        (MemoryNeeded(GB, 2 * GB, GB, 9 * GB, 1_000_000), 1, "--max-width", None),
        (MemoryNeeded(9 * GB, 1, 1, 1, 1_000), 1, "end other programs", None),
    ],
)
def test_what_does_not_fit_is_refused_with_the_option_of_the_largest_part(
    left, needed, room, option, most
):
    left(None)
    require_memory(needed)
    left(needed.total - GB)
    require_memory(needed)
    left(room * GB)
    with pytest.raises(UserError, match="would take about") as error:
        require_memory(needed)
    assert option in error.value.fix
    if most is None:
        return
    found = re.search(rf"{option} (\d+)", error.value.fix)
    # What is asked for instead does fit, and is not far below what would.
    assert found is not None
    asked = int(found[1])
    part = "gaussians" if option == "--gaussians" else "photographs"
    now = needed.population if part == "gaussians" else needed.photographs / 2**20
    smaller = needed._replace(**{part: getattr(needed, part) * asked / now})
    require_memory(smaller)
    assert smaller.total > (room + 1) * GB * 0.9


def test_a_fit_is_refused_before_its_exposures_are_solved(tmp_path, left, run_command):
    run = tmp_path / "run"
    made = make_scene(tmp_path / "scene", views=4, points=60)
    left(0.1 * GB)
    code, text = run_command("fit", made, "--out", run, "--gaussians", 9_000_000)
    assert code == 2
    assert "9000000 Gaussians" in text
    assert not (run / "config.json").exists()


class JaxRuntimeError(RuntimeError):
    """As JAX calls its own."""


@pytest.mark.parametrize(
    "error", [MemoryError(), JaxRuntimeError("RESOURCE_EXHAUSTED: 9 bytes\nat f")]
)
@pytest.mark.parametrize("checkpoint", [False, True])
def test_memory_that_runs_out_is_named(tmp_path, run_command, monkeypatch, error, checkpoint):
    made, run = make_scene(tmp_path / "scene", views=4, points=60), tmp_path / "run"
    decided = pipeline.Decisions.as_asked(ROBUST)
    monkeypatch.setattr(
        pipeline, "prepare", lambda *a, **k: SimpleNamespace(cfg=ROBUST, decisions=decided)
    )

    def optimise(*args, **options):
        if checkpoint:
            CheckpointStore(run / "checkpoints").save(3, {"a": np.zeros(2)}, {})
        raise error

    monkeypatch.setattr(pipeline.Optimiser, "run", optimise)
    code, text = run_command("fit", made, "--out", run)
    assert code == 2
    assert "memory ran out" in text
    assert "--gaussians" in text
    # Without a checkpoint there is nothing to continue, and other options may be tried.
    assert (run / "config.json").exists() == checkpoint


def test_other_commands_name_it_too(tmp_path, run_command, monkeypatch):
    from p2gs_jax.cli.experiments import Synth

    def run(options):
        raise MemoryError("Unable to allocate 9 TB")

    monkeypatch.setattr(Synth, "execute", run)
    code, text = run_command("synth", tmp_path / "new")
    assert code == 2
    assert "memory ran out (Unable to allocate 9 TB)" in text
