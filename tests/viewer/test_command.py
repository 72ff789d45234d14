"""`p2gs-jax view`: wrong input, and how it ends."""

import os
import re
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


def test_without_viser_it_says_how_to_get_it(run_command, monkeypatch, tmp_path):
    for name in [n for n in sys.modules if n.startswith("p2gs_jax.viewer")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "viser", None)
    code, text = run_command("view", tmp_path)
    assert code == 2
    assert "pip install 'p2gs-jax[viewer]'" in text


class TestWithViser:
    @pytest.fixture(autouse=True)
    def _viser(self):
        pytest.importorskip("viser", reason="the extra `viewer` is not installed")

    def test_no_run(self, run_command, tmp_path):
        code, text = run_command("view", tmp_path, "--port", "0")
        assert code == 2
        assert str(tmp_path) in text.replace("\n", "")

    def test_busy_port(self, run_command, tmp_path):
        with socket.socket() as taken:
            taken.bind(("127.0.0.1", 0))
            taken.listen()
            port = taken.getsockname()[1]
            code, text = run_command("view", tmp_path, "--port", port)
        assert code == 2
        assert str(port) in text
        assert "--port" in text

    @pytest.mark.parametrize(
        "option", [("--port", "70000"), ("--host", "no.such.host.invalid"), ("--max-width", "3")]
    )
    def test_senseless_options(self, run_command, tmp_path, option):
        code, text = run_command("view", tmp_path, *option)
        assert code == 2
        assert option[0] in text

    def test_ctrl_c_ends_it_cleanly(self, finished_run):
        argv = [sys.executable, "-m", "p2gs_jax.cli", "view", str(finished_run), "--port", "0"]
        process = subprocess.Popen(
            argv,
            cwd=ROOT,
            env=os.environ | {"PYTHONPATH": str(ROOT)},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        line = process.stdout.readline()
        assert re.search(r"http://127\.0\.0\.1:\d+ ", line)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=120)
        assert process.returncode == 0, err
        assert "Traceback" not in out + err
