"""Compiled programs are kept where they belong, and only there."""

import os
import subprocess
import sys

CHILD = """
import jax, jax.numpy as jnp
from p2gs_jax.core import runtime
runtime.SHORTEST_S = 0.0
runtime.use_compile_cache()
print(jax.config.values["jax_compilation_cache_dir"])
jax.jit(lambda x: jnp.sin(x) @ x)(jnp.ones((8, 8))).block_until_ready()
"""


def run(**variables) -> str:
    kept = {k: v for k, v in os.environ.items() if not k.startswith("JAX_")}
    done = subprocess.run(
        [sys.executable, "-c", CHILD],
        env=kept | {"JAX_PLATFORMS": "cpu"} | variables,
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout.strip()


def test_programs_are_kept_for_this_machine_where_they_can_be(tmp_path):
    folder = run(XDG_CACHE_HOME=str(tmp_path))
    assert folder.startswith(str(tmp_path / "p2gs-jax"))
    assert list((tmp_path / "p2gs-jax").rglob("*-cache"))
    chosen = str(tmp_path / "chosen")
    assert run(XDG_CACHE_HOME=str(tmp_path / "xdg"), JAX_COMPILATION_CACHE_DIR=chosen) == chosen
    assert not (tmp_path / "xdg").exists()
    (tmp_path / "file").write_text("in the way")
    assert run(XDG_CACHE_HOME=str(tmp_path / "file")) == "None"
