"""The web server: access control, one viewed run, and a session for every browser.

Only the page of the viewer may connect, and other machines need a token. Otherwise a page
of any other site in the same browser could connect to a port of this machine (WebSockets have no
same-origin policy, RFC 6455, 10.2), even through a host name that resolves to this machine. viser
has no hook for such checks, so its call of the `websockets` library is wrapped during the start.
"""

from __future__ import annotations

import contextlib
import hmac
import http
import io
import ipaddress
import logging
import secrets
import socket
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from http.cookies import CookieError, SimpleCookie
from typing import Any, NamedTuple
from urllib.parse import parse_qs, urlsplit

import viser
import websockets.asyncio.server as websocket_server
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from p2gs_jax.core import interrupts
from p2gs_jax.core.atomic import read_jsonl
from p2gs_jax.errors import UserError
from p2gs_jax.run.read import Run
from p2gs_jax.viewer.follow import POLL_S, Follower
from p2gs_jax.viewer.renderer import compilation_order, full_size, render_sizes
from p2gs_jax.viewer.session import BrowserSession
from p2gs_jax.viewer.viewed_run import ViewedRun

# Canvas of a common browser window, pixels; its programs are compiled before a browser connects.
LIKELY_CANVAS = (1280, 800)
COOKIE, QUERY = "p2gs_jax_token", "token"
_STARTING = threading.Lock()
_LOOPBACK_NAMES = ("localhost", "127.0.0.1", "::1")

Hook = Callable[[ServerConnection, Request], Response | None]


class Guard(NamedTuple):
    """Conditions for a request: its host name (`hosts` None: any), and its token (None: no token).

    The token must be in the address, or in the cookie that the first answer sets.
    """

    hosts: frozenset[str] | None
    token: str | None = None

    def refusal(self, request: Request) -> str | None:
        """Return the reason to refuse a request, or None."""
        host = request.headers.get("Host", "")
        if self.hosts is not None and _name(host) not in self.hosts:
            return "This viewer does not serve that host name."
        origin = request.headers.get("Origin")
        if origin is not None and origin.lower().partition("://")[2] != host.lower():
            return "This viewer accepts requests of its page only."
        if self.token is not None and not any(
            hmac.compare_digest(token.encode(), self.token.encode()) for token in _tokens(request)
        ):
            return "Open the complete address that `p2gs-jax view` printed, with its token."
        return None


def guard_of(host: str) -> Guard:
    """Return the guard of a listening address, with a token if other machines can reach it."""
    if is_loopback(host):
        return Guard(frozenset({*_LOOPBACK_NAMES, host.lower()}))
    return Guard(None, secrets.token_urlsafe(16))


def is_loopback(host: str) -> bool:
    """Return whether only this machine can reach an address."""
    try:
        found = socket.getaddrinfo(host, None, flags=socket.AI_PASSIVE)
    except (OSError, UnicodeError):
        return False
    addresses = [str(address[0]).partition("%")[0] for *_, address in found]
    return bool(host) and all(ipaddress.ip_address(a).is_loopback for a in addresses)


@contextlib.contextmanager
def guarded(guard: Guard) -> Iterator[None]:
    """Apply a guard to every server of `websockets` that starts in the `with` block."""
    # A message that viser cannot read ends its connection; `websockets` also prints a traceback.
    logging.getLogger("websockets.server").setLevel(logging.CRITICAL)
    with _STARTING:
        serve = websocket_server.serve

        def guarded_serve(*args: Any, process_request: Hook | None = None, **options: Any) -> Any:
            return serve(*args, process_request=_hook(guard, process_request), **options)

        websocket_server.serve = guarded_serve  # type: ignore[assignment, misc]
        try:
            yield
        finally:
            websocket_server.serve = serve  # type: ignore[misc]


def _hook(guard: Guard, inner: Hook | None) -> Hook:
    def process(connection: ServerConnection, request: Request) -> Response | None:
        refusal = guard.refusal(request)
        if refusal is not None:
            return connection.respond(http.HTTPStatus.FORBIDDEN, refusal + "\n")
        try:
            answer = None if inner is None else inner(connection, request)
        except OSError:  # the path is too long for the name of a file
            return connection.respond(http.HTTPStatus.NOT_FOUND, "This page does not exist.\n")
        if answer is not None and guard.token is not None:
            cookie = f"{_cookie(request)}={guard.token}"
            answer.headers["Set-Cookie"] = f"{cookie}; HttpOnly; SameSite=Strict"
            answer.headers["Referrer-Policy"] = "no-referrer"
        return answer

    return process


def _name(host: str) -> str:
    """Return a Host header without its port."""
    try:
        return (urlsplit(f"//{host}").hostname or "").lower()
    except ValueError:
        return ""


def _cookie(request: Request) -> str:
    """Return the cookie name, with the port: browsers send cookies to all ports of a host."""
    port = request.headers.get("Host", "").rpartition(":")[2]
    return f"{COOKIE}_{port}" if port.isdecimal() and port.isascii() else COOKIE


def _tokens(request: Request) -> list[str]:
    """Return the tokens in the address and the cookies of a request."""
    found = parse_qs(request.path.partition("?")[2]).get(QUERY, [])
    try:
        for header in request.headers.get_all("Cookie"):
            cookie = SimpleCookie(header).get(_cookie(request))
            found = [*found, cookie.value] if cookie is not None else found
    except CookieError:
        pass
    return found


def check_address(host: str, port: int) -> None:
    """Raise UserError if no server can listen on an address."""
    if not 0 <= port <= 65535:
        raise UserError(f"--port {port} is not a valid port.", fix="choose one from 1024 to 65535")
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
    except (OSError, UnicodeError) as error:
        fix = "leave it out"
        raise UserError(f"--host {host!r} is not a valid address: {error}.", fix=fix) from None
    with socket.socket(family, kind, protocol) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(address)
        except OSError as error:
            why = f"cannot listen on {host}, port {port}: {error.strerror or error}."
            fix = f"choose another with --port, such as --port {port + 1}, or 0 for any free one"
            raise UserError(why, fix=fix) from None


@contextlib.contextmanager
def open_viewer(
    run: Run, *, host: str, port: int, max_width: int, follower: Follower | None = None
) -> Iterator[str]:
    """Serve a run until the block ends; yield the address to open, with its token if it needs one.

    If a fit still writes the run, `follower` follows it, and nothing is compiled before a browser
    connects. Live pictures are at most `max_width` pixels wide. Raises UserError: no server can
    listen on `host` and `port`.
    """
    check_address(host, port)
    # viser warns when a browser disconnects while a picture is being sent.
    warnings.filterwarnings("ignore", message="Queued a .* on a closed connection")
    viewed = ViewedRun(run, max_width)
    guard = guard_of(host)
    with guarded(guard), contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(
            host=host, port=port, label=f"p2gs-jax: {run.folder.name}", verbose=False
        )
    sessions: dict[int, BrowserSession] = {}
    ended = threading.Event()
    following = threading.Thread(target=_follow, args=(follower, viewed, sessions, ended))
    try:
        if port not in (0, server.get_port()):
            raise UserError(f"port {port} has become busy.", fix="choose another with --port")
        _set_up_server(server, viewed, sessions)
        if follower is None:
            sizes = render_sizes(full_size(LIKELY_CANVAS, max_width))
            viewed.renderer.request(compilation_order(sizes))
        else:
            following.start()
        name = "localhost" if host in ("0.0.0.0", "::", "") else host
        address = f"http://{f'[{name}]' if ':' in name else name}:{server.get_port()}"
        yield address if guard.token is None else f"{address}/?{QUERY}={guard.token}"
    finally:
        ended.set()
        if following.is_alive():
            following.join()
        for session in tuple(sessions.values()):
            session.stop()
        viewed.renderer.stop()
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()
        viewed.store.close()


def _follow(
    follower: Follower, viewed: ViewedRun, sessions: dict[int, Any], ended: threading.Event
) -> None:
    """Show the newest state of a fit in all browsers, until `ended` is set."""
    while not ended.wait(POLL_S):
        run = follower.poll(wanted=bool(sessions))
        if run is not None:
            viewed.show(run)
        log = read_jsonl(follower.files.log) if sessions else []
        for session in tuple(sessions.values()) if log else ():
            session.follow(log, newer=run is not None)


def _set_up_server(
    server: viser.ViserServer, viewed: ViewedRun, sessions: dict[int, BrowserSession]
) -> None:
    """Set the theme of the page, the initial camera, and the handlers of connections.

    The handlers keep `sessions` (by the ids of connected browsers) up to date.
    """
    server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
    # Even without its button, any page could ask viser to publish the run through its relay.
    server.request_share_url = lambda verbose=True: None
    server.scene.set_up_direction(viewed.space.up)
    start = viewed.pose(viewed.first_view, LIKELY_CANVAS)
    camera = server.initial_camera
    camera.position, camera.look_at, camera.fov = start.position, start.look_at, start.fov
    lock = threading.Lock()
    # Browsers that disconnected before they had a session: viser calls from several threads.
    gone: set[int] = set()

    @server.on_client_connect
    def _(client: viser.ClientHandle) -> None:
        session = BrowserSession(client, viewed)
        with lock:
            has_left = client.client_id in gone
            gone.discard(client.client_id)
            if not has_left:
                sessions[client.client_id] = session
        if has_left:
            session.stop()

    @server.on_client_disconnect
    def _(client: viser.ClientHandle) -> None:
        with lock:
            session = sessions.pop(client.client_id, None)
            if session is None:
                gone.add(client.client_id)
        if session is not None:
            session.stop()


def serve(
    run: Run, *, say: Callable[[str], None], follower: Follower | None = None, **options: Any
) -> None:
    """Serve a run until Ctrl-C or SIGTERM, or until its fit ends if `follower.with_fit`.

    `say` prints a line; `open_viewer` explains its other arguments (`options`) and errors.
    """
    with open_viewer(run, follower=follower, **options) as address:
        local = is_loopback(options["host"])
        who = "only this machine" if local else "any machine with this address"
        shown = "Watch the fit" if follower else f"{run.params.gaussians.capacity} Gaussians"
        with contextlib.suppress(KeyboardInterrupt), interrupts.held() as signals:
            # Signals are recorded, not raised: Python drops exceptions during garbage collection.
            signals.begin()
            say(f"{shown} at {address} (open to {who}; Ctrl-C ends)")
            while signals.arrived is None:
                if follower is not None and follower.with_fit and not follower.goes_on:
                    break
                time.sleep(0.1)
        say("The viewer stops after the compilation in progress.")
