"""The web server: one viewed run, and a session for every browser."""

from __future__ import annotations

import contextlib
import io
import os
import signal
import socket
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import viser

from p2gs_jax.errors import UserError
from p2gs_jax.run.read import Run
from p2gs_jax.viewer.guard import QUERY, guard_of, guarded, is_loopback
from p2gs_jax.viewer.render_sizes import compilation_order, full_size, render_sizes
from p2gs_jax.viewer.session import BrowserSession
from p2gs_jax.viewer.viewed_run import ViewedRun

# Canvas of a common browser window: its programs are compiled before any browser connects.
LIKELY_CANVAS = (1280, 800)


def check_address(host: str, port: int) -> None:
    """Check that a server can listen on an address.

    Raises:
        UserError: the port is taken or not allowed, or the host is none of this machine's.
    """
    if not 0 <= port <= 65535:
        raise UserError(f"--port {port} is no port.", fix="choose one from 1024 to 65535")
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
    except (OSError, UnicodeError) as error:
        raise UserError(f"--host {host!r} is no address: {error}.", fix="leave it out") from None
    with socket.socket(family, kind, protocol) as probe:
        if os.name == "posix":
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(address)
        except OSError as error:
            raise UserError(
                f"cannot listen on {host}, port {port}: {error.strerror or error}.",
                fix=f"choose another with --port, such as --port {port + 1}, or 0 for any free one",
            ) from None


@contextmanager
def open_viewer(run: Run, *, host: str, port: int, max_width: int) -> Iterator[str]:
    """Serve a run until the block ends; yield the address to open, with its token if it needs one.

    Args:
        run: the run to show.
        host: address to listen on.
        port: to listen on; 0 takes any free one.
        max_width: widest picture to render, pixels.

    Raises:
        UserError: one cannot listen there.
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
    try:
        if port not in (0, server.get_port()):
            raise UserError(f"port {port} was taken just now.", fix="choose another with --port")
        _set_up_server(server, viewed, sessions)
        viewed.programs.request(
            compilation_order(render_sizes(full_size(LIKELY_CANVAS, max_width)))
        )
        shown = "localhost" if host in ("0.0.0.0", "::", "") else host
        address = f"http://{f'[{shown}]' if ':' in shown else shown}:{server.get_port()}"
        yield address if guard.token is None else f"{address}/?{QUERY}={guard.token}"
    finally:
        for session in tuple(sessions.values()):
            session.stop()
        viewed.programs.stop()
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()
        viewed.store.close()


def _set_up_server(
    server: viser.ViserServer, viewed: ViewedRun, sessions: dict[int, BrowserSession]
) -> None:
    """Set the page's theme, the initial camera, and what happens when a browser connects.

    Args:
        server: the server.
        viewed: the run to show.
        sessions: of the connected browsers, by their ids; kept up to date.
    """
    server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
    # Any page could ask viser's relay to publish the run, also without a button for it.
    server.request_share_url = lambda verbose=True: None
    server.scene.set_up_direction(viewed.space.up)
    start = viewed.pose(viewed.first_view, LIKELY_CANVAS[0] / LIKELY_CANVAS[1])
    camera = server.initial_camera
    camera.position, camera.look_at, camera.fov = start.position, start.look_at, start.fov
    lock = threading.Lock()
    # Browsers that left while their session was being made: viser calls from several threads.
    gone: set[int] = set()

    @server.on_client_connect
    def _(client: viser.ClientHandle) -> None:
        session = BrowserSession(client, viewed)
        with lock:
            left = client.client_id in gone
            gone.discard(client.client_id)
            if not left:
                sessions[client.client_id] = session
        if left:
            session.stop()

    @server.on_client_disconnect
    def _(client: viser.ClientHandle) -> None:
        with lock:
            session = sessions.pop(client.client_id, None)
            if session is None:
                gone.add(client.client_id)
        if session is not None:
            session.stop()


def serve(run: Run, *, host: str, port: int, max_width: int, say: Callable[[str], None]) -> None:
    """Serve a run until Ctrl-C or SIGTERM; a second one ends the process at once.

    For the main thread.

    Args:
        run: what to show.
        host: address to listen on.
        port: to listen on.
        max_width: widest picture to render, pixels.
        say: prints a line.

    Raises:
        UserError: one cannot listen there.
    """
    asked: list[int] = []

    def end(number: int, frame: object) -> None:
        if asked:
            os._exit(128 + number)
        asked.append(number)

    before = {number: signal.signal(number, end) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        with open_viewer(run, host=host, port=port, max_width=max_width) as address:
            who = "only this machine" if is_loopback(host) else "any machine with this address"
            say(
                f"{run.params.gaussians.capacity} Gaussians at {address} (open to {who}; Ctrl-C "
                "ends)"
            )
            while not asked:
                time.sleep(0.1)
            say("Ending, once what is being compiled is done.")
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
