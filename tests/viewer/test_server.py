"""`p2gs-jax view`: wrong input, access, browsers that disconnect, and the end of the server."""

import os
import re
import signal
import socket
import subprocess
import sys
import urllib.error
import urllib.request
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest

pytest.importorskip("viser", reason="the extra `viewer` is not installed")

import viser
import websockets
import websockets.sync.client

from p2gs_jax.core import interrupts
from p2gs_jax.viewer import server as module
from p2gs_jax.viewer.server import Guard, guard_of, guarded, is_loopback

ROOT = Path(__file__).resolve().parents[2]
PROTOCOL = f"viser-v{viser.__version__}"


def test_without_viser_the_error_says_how_to_install_it(refused, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "viser", None)
    for words in (("view", tmp_path), ("fit", tmp_path, "--view")):
        assert "pip install 'p2gs-jax[viewer]'" in refused(*words)


def test_a_busy_port_is_refused(refused, tmp_path):
    with socket.socket() as busy:
        busy.bind(("127.0.0.1", 0))
        busy.listen()
        port = busy.getsockname()[1]
        text = refused("view", tmp_path, "--port", port)
    assert str(port) in text
    assert "--port" in text


def test_ctrl_c_ends_the_server_cleanly(finished_run):
    process = subprocess.Popen(
        [sys.executable, "-m", "p2gs_jax.cli", "view", str(finished_run), "--port", "0"],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert re.search(r"http://127\.0\.0\.1:\d+ ", process.stdout.readline())
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=120)
    assert process.returncode == 0, err
    assert "Traceback" not in out + err


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_signal_during_garbage_collection_ends_the_server(monkeypatch):
    class Collected:
        def __del__(self):
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(module, "open_viewer", lambda run, **options: nullcontext("an address"))
    lines, garbage = [], [Collected()]

    def say(line):
        garbage.clear()
        lines.append(line)

    run = SimpleNamespace(params=SimpleNamespace(gaussians=SimpleNamespace(capacity=3)))
    with interrupts.raised():
        module.serve(run, host="127.0.0.1", port=0, max_width=64, say=say)
    assert len(lines) == 2


def test_only_loopback_needs_no_token():
    loopback = ("127.0.0.1", "::1", "localhost", "127.8.9.1")
    for host in (*loopback, "0.0.0.0", "::", "", "no.such.host.invalid"):
        guard = guard_of(host)
        assert is_loopback(host) == (host in loopback)
        assert (guard.token is None) == (guard.hosts is not None) == (host in loopback)
        assert host in loopback or guard.token != guard_of(host).token


def start(guard):
    with guarded(guard):
        return viser.ViserServer(host="127.0.0.1", port=0, verbose=False)


@pytest.fixture(scope="module")
def servers():
    """Return a server for this machine and one with a token; both listen on loopback only."""
    found = [start(guard_of("127.0.0.1")), start(Guard(None, "secret"))]
    yield found
    for server in found:
        server.stop()


def get(server, path="/", **headers):
    """Return the HTTP status of a page, and the cookie that it sets."""
    request = urllib.request.Request(f"http://127.0.0.1:{server.get_port()}{path}", headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=20) as answer:
            return answer.status, answer.headers.get("Set-Cookie", "")
    except urllib.error.HTTPError as error:
        return error.code, error.headers.get("Set-Cookie", "")


def connects(server, origin=None, **headers):
    """Return whether the server accepts a WebSocket.

    The client is synchronous: the test session's browser already runs an event loop here.
    """
    try:
        with websockets.sync.client.connect(
            f"ws://127.0.0.1:{server.get_port()}",
            origin=origin,
            additional_headers=headers,
            subprotocols=[PROTOCOL],
        ) as channel:
            return bool(channel.recv(20))
    except websockets.InvalidStatus as error:
        return error.response.status_code != 403


def test_the_viewer_s_page_is_served(servers):
    server = servers[0]
    assert get(server) == (200, "")
    for name in ("127.0.0.1", "localhost"):
        host = f"{name}:{server.get_port()}"
        assert get(server, Host=host, Origin=f"http://{host}")[0] == 200
    assert connects(server)
    assert connects(server, origin=f"http://127.0.0.1:{server.get_port()}")


def test_requests_from_other_sites_and_for_other_host_names_are_refused(servers):
    for origin in ("http://evil.example", "http://127.0.0.1:1", "null", "http://[", ""):
        assert get(servers[0], Origin=origin)[0] == 403
        assert not origin or not connects(servers[0], origin=origin)
    for host in ("evil.example", "evil.example:80", "127.0.0.1.evil.example", "["):
        assert get(servers[0], Host=host, Origin=f"http://{host}")[0] == 403


def test_what_viser_cannot_read_ends_one_connection_or_is_not_found(servers, caplog):
    address = f"ws://127.0.0.1:{servers[0].get_port()}"
    for message in (b"garbage", "text"):
        with websockets.sync.client.connect(address, subprotocols=[PROTOCOL]) as channel:
            channel.send(message)
            with pytest.raises(websockets.ConnectionClosedError):
                list(channel)
    assert not caplog.records
    assert get(servers[0], "/" + "a" * 300)[0] == 404
    assert connects(servers[0])


def test_other_machines_need_the_token(servers):
    server = servers[1]
    for path in ("/", "/?token=", "/?token=wrong", "/?token=secre", "/index.html", "/?t=secret"):
        assert get(server, path) == (403, "")
    assert not connects(server)
    port = server.get_port()
    assert not connects(server, Cookie=f"p2gs_jax_token_{port}=wrong")
    status, cookie = get(server, "/?token=secret")
    assert status == 200
    assert "HttpOnly" in cookie
    assert "SameSite=Strict" in cookie
    kept = cookie.split(";")[0]
    assert get(server, "/", Cookie=kept)[0] == 200
    assert connects(server, Cookie=kept)
    assert not connects(server, origin="http://evil.example", Cookie=kept)
    # A browser keeps cookies by host, not by port: it also sends the cookie of another viewer.
    assert kept == f"p2gs_jax_token_{port}=secret"
    assert connects(server, Cookie=f"p2gs_jax_token_{port + 1}=other; {kept}")


def test_the_session_of_a_browser_that_disconnects_stops_once(monkeypatch):
    # Sessions by browser, and the ids of browsers whose sessions were made and stopped.
    served = SimpleNamespace(sessions={}, made=[], stopped=[], on_made=None)

    class Session:
        def __init__(self, client, viewed):
            self.client = client
            served.made.append(client.client_id)
            if served.on_made is not None:
                served.on_made(client)

        def stop(self):
            served.stopped.append(self.client.client_id)

    monkeypatch.setattr(module, "BrowserSession", Session)
    server = MagicMock()
    server.on_client_connect = lambda call: setattr(served, "connect", call)
    server.on_client_disconnect = lambda call: setattr(served, "disconnect", call)
    pose = SimpleNamespace(position=np.zeros(3), look_at=np.ones(3), fov=1.0)
    space, view = SimpleNamespace(up="+z"), lambda view, canvas: pose
    viewed = SimpleNamespace(space=space, first_view=0, pose=view)
    module._set_up_server(server, viewed, served.sessions)
    clients = [SimpleNamespace(client_id=k) for k in range(3)]
    for client in clients:
        served.connect(client)
    assert sorted(served.sessions) == [0, 1, 2]
    served.disconnect(clients[1])
    assert sorted(served.sessions) == [0, 2]
    assert served.stopped == [1]
    # These browsers disconnect while their session is made.
    served.on_made = served.disconnect
    for number in (5, 6):
        served.connect(SimpleNamespace(client_id=number))
    assert served.made[3:] == served.stopped[1:] == [5, 6]
    assert sorted(served.sessions) == [0, 2]
