"""Checkpoints are restored bit for bit; kills and broken files leave the last good one."""

import random
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from splats import random_splats

from p2gs_jax import FitConfig, Params, Photometry, UserError
from p2gs_jax.run.checkpoint import CheckpointStore
from p2gs_jax.train.optimizer import make_optimizer
from p2gs_jax.train.state import grow_state, initial_state


def state(capacity, seed=0):
    gaussians = random_splats(capacity, seed=seed)
    params = Params(gaussians, Photometry(jnp.zeros(4), jnp.ones(4), "linear"))
    return initial_state(params, jnp.ones(capacity, bool), make_optimizer(FitConfig()))


def assert_same(a, b):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert np.asarray(x).dtype == np.asarray(y).dtype
        assert np.asarray(x).tobytes() == np.asarray(y).tobytes()


def biggest(folder):
    return max((p for p in folder.rglob("*") if p.is_file()), key=lambda p: p.stat().st_size)


def test_checkpoints_are_exact_and_the_last_two_are_kept(tmp_path):
    store = CheckpointStore(tmp_path / "c")
    assert store.latest_step() is None
    assert store.restore_latest(lambda meta: {}) is None
    trees = {s: {"a": state(50, s), "n": jnp.int32(s)} for s in (1, 2, 3)}
    for s, tree in trees.items():
        store.save(s, tree, {"capacity": 50 + s})
    store = CheckpointStore(tmp_path / "c")
    assert store.latest_step() == 3
    assert store.read_meta(3) == {"capacity": 53}
    tree, meta = store.restore_latest(lambda meta: trees[3])
    assert meta == {"capacity": 53}
    assert_same(tree, trees[3])
    assert_same(store.restore(2, trees[2])[0], trees[2])
    with pytest.raises(UserError):
        store.restore(1, trees[1])
    store.discard_after(2)
    assert store.latest_step() == 2


def test_a_grown_population_is_restored_by_its_stored_capacity(tmp_path):
    grown = grow_state(state(20), 37)
    CheckpointStore(tmp_path / "c").save(7, grown, {"capacity": grown.params.gaussians.capacity})
    found = CheckpointStore(tmp_path / "c").restore_latest(
        lambda meta: jax.eval_shape(lambda: grow_state(state(20), meta["capacity"]))
    )
    assert found is not None
    assert_same(found[0], grown)
    assert found[0].params.photometry.parameterization == "linear"


def test_unusual_leaves_and_values_are_restored(tmp_path):
    odd = jnp.array([jnp.nan, -0.0, jnp.inf, 1e-42])
    tree = {"nan": odd, "none": None, "empty": jnp.zeros((0, 3)), "scalar": jnp.int32(7)}
    tree |= {"bool": jnp.array([True, False]), "bfloat16": jnp.ones((2, 2), jnp.bfloat16)}
    tree |= {"schedule": optax.ScaleByScheduleState(jnp.int32(3))}
    store = CheckpointStore(tmp_path / "c")
    store.save(0, tree, {"e": np.float64(0.1), "n": jnp.int32(3), "a": np.arange(2), "s": [None]})
    back, meta = store.restore(0, tree)
    assert_same(back, tree)
    assert meta == {"e": 0.1, "n": 3, "a": [0, 1], "s": [None]}
    with pytest.raises(TypeError, match="PosixPath"):
        store.save(1, tree, {"path": tmp_path})
    assert store.latest_step() == 0


@pytest.mark.parametrize(
    ("like", "message"),
    [
        ({"x": jnp.zeros(5), "y": jnp.zeros(2)}, "'x'.*4.*5"),
        ({"x": jnp.zeros(4, jnp.int32), "y": jnp.zeros(2)}, "'x'.*float32.*int32"),
        ({"x": jnp.zeros(4)}, "'y'.*absent"),
        ({"x": jnp.zeros(4), "y": jnp.zeros(2), "z": jnp.zeros(1)}, "'z'.*absent"),
    ],
)
def test_another_structure_is_refused(tmp_path, like, message):
    store = CheckpointStore(tmp_path / "c")
    store.save(1, {"x": jnp.zeros(4), "y": jnp.zeros(2)}, {})
    with pytest.raises(UserError, match=f"another version or configuration.*{message}"):
        store.restore(1, like)


def flip(path):
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 4
    path.write_bytes(content)


DAMAGES = {
    "flipped bit": lambda folder: flip(biggest(folder)),
    "cut file": lambda folder: biggest(folder).write_bytes(biggest(folder).read_bytes()[:100]),
    "lost file": lambda folder: biggest(folder).unlink(),
    "emptied": lambda folder: [p.write_bytes(b"") for p in folder.rglob("*") if p.is_file()],
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES.keys())
def test_in_place_of_a_broken_checkpoint_the_one_before_it_is_restored(tmp_path, damage, capfd):
    store = CheckpointStore(tmp_path / "c")
    trees = {s: {"x": jnp.full(5000, float(s)), "y": jnp.full(300, s)} for s in (1, 2)}
    for s, tree in trees.items():
        store.save(s, tree, {"s": s})
    damage(tmp_path / "c" / "2")
    capfd.readouterr()
    messages = []
    found = CheckpointStore(tmp_path / "c").restore_latest(lambda m: trees[1], messages.append)
    assert found is not None
    assert_same(found[0], trees[1])
    assert found[1] == {"s": 1}
    assert len(messages) == 1
    assert str(tmp_path / "c" / "2") in messages[0]
    damage(tmp_path / "c" / "1")
    with pytest.raises(UserError, match="c/1 cannot be read"):
        store.restore_latest(lambda m: trees[1], messages.append)
    assert capfd.readouterr() == ("", "")


CHILD = """
import sys, numpy as np
from pathlib import Path
from p2gs_jax.run.checkpoint import CheckpointStore
store = CheckpointStore(Path(sys.argv[1]))
step = (store.latest_step() or 0) + 1
while True:
    store.save(step, {"x": np.full(2_000_000, step, np.float32)}, {"step": step})
    print(step, flush=True)
    step += 1
"""


def test_killed_at_any_moment_the_last_good_checkpoint_stays(tmp_path):
    folder, moments = tmp_path / "c", random.Random(0)
    like = {"x": jax.ShapeDtypeStruct((2_000_000,), np.dtype("float32"))}
    for _ in range(3):
        child = subprocess.Popen(
            [sys.executable, "-c", CHILD, str(folder)], stdout=subprocess.PIPE, text=True
        )
        assert child.stdout is not None
        child.stdout.readline()
        time.sleep(moments.uniform(0, 0.3))
        child.kill()
        written = [int(line) for line in child.stdout.read().split()]
        child.wait()
        store = CheckpointStore(folder)
        messages = []
        found = store.restore_latest(lambda meta: like, messages.append)
        assert found is not None
        tree, meta = found
        assert messages == []
        assert meta["step"] == store.latest_step() >= max(written, default=1)
        assert np.all(tree["x"] == meta["step"])
    # Remains of killed processes are removed in the background; a save waits for this.
    store.save(meta["step"] + 1, tree, meta)
    assert not [p.name for p in folder.iterdir() if not p.name.isdecimal()]
