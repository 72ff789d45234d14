"""Who may talk to the viewer."""

import urllib.error
import urllib.request

import pytest

pytest.importorskip("viser", reason="the extra `viewer` is not installed")
import viser
import websockets
import websockets.sync.client

from p2gs_jax.viewer.server import Guard, guard_of, guarded, is_loopback

PROTOCOL = f"viser-v{viser.__version__}"


@pytest.mark.parametrize(
    ("host", "alone"),
    [
        *((host, True) for host in ("127.0.0.1", "::1", "localhost", "127.8.9.1")),
        *((host, False) for host in ("0.0.0.0", "::", "", "no.such.host.invalid")),
    ],
)
def test_only_loopback_needs_no_token(host, alone):
    assert is_loopback(host) == alone
    guard = guard_of(host)
    assert (guard.token is None) == alone
    assert (guard.hosts is not None) == alone


def test_tokens_are_not_used_twice():
    assert guard_of("0.0.0.0").token != guard_of("0.0.0.0").token


def start(guard):
    with guarded(guard):
        return viser.ViserServer(host="127.0.0.1", port=0, verbose=False)


@pytest.fixture(scope="module")
def servers():
    """Return servers as for this machine and as for others; both listen on loopback only."""
    found = [start(guard_of("127.0.0.1")), start(Guard(None, "secret"))]
    yield found
    for server in found:
        server.stop()


def get(server, path="/", **headers):
    """Return the status of a page, and the cookie that is set."""
    url = f"http://127.0.0.1:{server.get_port()}{path}"
    request = urllib.request.Request(url, headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=20) as answer:
            return answer.status, answer.headers.get("Set-Cookie", "")
    except urllib.error.HTTPError as error:
        return error.code, error.headers.get("Set-Cookie", "")


def connects(server, origin=None, **headers):
    """Return whether a WebSocket is let in.

    Without an event loop: the session's browser keeps one running in this thread.
    """
    try:
        with websockets.sync.client.connect(
            f"ws://127.0.0.1:{server.get_port()}",
            origin=origin,
            additional_headers=headers,
            subprotocols=[PROTOCOL],
        ) as socket:
            return bool(socket.recv(20))
    except websockets.InvalidStatus as error:
        return error.response.status_code != 403


def test_the_viewer_s_own_page_is_served(servers):
    server = servers[0]
    assert get(server) == (200, "")
    for name in ("127.0.0.1", "localhost"):
        host = f"{name}:{server.get_port()}"
        assert get(server, Host=host, Origin=f"http://{host}")[0] == 200
    assert connects(server)
    assert connects(server, origin=f"http://127.0.0.1:{server.get_port()}")


@pytest.mark.parametrize(
    "origin", ["http://evil.example", "http://127.0.0.1:1", "null", "http://[", ""]
)
def test_pages_of_other_sites_are_refused(servers, origin):
    assert get(servers[0], Origin=origin)[0] == 403
    if origin:
        assert not connects(servers[0], origin=origin)


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "127.0.0.1.evil.example", "["])
def test_names_that_were_made_to_point_here_are_refused(servers, host):
    assert get(servers[0], Host=host, Origin=f"http://{host}")[0] == 403


def test_others_need_the_token(servers):
    server = servers[1]
    for path in ("/", "/?token=", "/?token=wrong", "/?token=secre", "/index.html", "/?t=secret"):
        assert get(server, path) == (403, "")
    assert not connects(server)
    assert not connects(server, Cookie="p2gs_jax_token=wrong")
    status, cookie = get(server, "/?token=secret")
    assert status == 200
    assert "HttpOnly" in cookie
    assert "SameSite=Strict" in cookie
    kept = cookie.split(";")[0]
    assert get(server, "/", Cookie=kept)[0] == 200
    assert connects(server, Cookie=kept)
    assert not connects(server, origin="http://evil.example", Cookie=kept)


def test_other_servers_are_left_alone():
    before = websockets.asyncio.server.serve
    with guarded(Guard(None)):
        assert websockets.asyncio.server.serve is not before
    assert websockets.asyncio.server.serve is before
