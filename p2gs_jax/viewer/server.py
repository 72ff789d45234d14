"""The web server: one studio, and a session for every browser."""

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
from p2gs_jax.viewer.ladder import full_size, ladder, order_of_compilation
from p2gs_jax.viewer.session import Session
from p2gs_jax.viewer.studio import Studio

# Canvas of a common browser window, compiled for before anyone has connected.
LIKELY_CANVAS = (1280, 800)


def check_address(host: str, port: int) -> None:
    """Make sure that one can listen there.

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
    """Serve a run until the block ends; yield the address to open.

    Args:
        run: what to show.
        host: address to listen on.
        port: likewise; 0 takes any free one.
        max_width: widest picture to render, pixels.

    Raises:
        UserError: one cannot listen there.
    """
    check_address(host, port)
    # A browser that goes while a picture is on its way is nothing to warn of.
    warnings.filterwarnings("ignore", message="Queued a .* on a closed connection")
    studio = Studio(run, max_width)
    with contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(
            host=host, port=port, label=f"p2gs-jax: {run.folder.name}", verbose=False
        )
    sessions: dict[int, Session] = {}
    try:
        if port not in (0, server.get_port()):
            raise UserError(f"port {port} was taken just now.", fix="choose another with --port")
        _furnish(server, studio, sessions)
        studio.programs.want(order_of_compilation(ladder(full_size(LIKELY_CANVAS, max_width))))
        shown = "localhost" if host in ("0.0.0.0", "::", "") else host
        yield f"http://{f'[{shown}]' if ':' in shown else shown}:{server.get_port()}"
    finally:
        for session in tuple(sessions.values()):
            session.stop()
        studio.programs.stop()
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()
        studio.store.close()


def _furnish(server: viser.ViserServer, studio: Studio, sessions: dict[int, Session]) -> None:
    """Set the look of the page, where cameras begin, and what happens when a browser comes.

    Args:
        server: the server.
        studio: what it shows.
        sessions: those of the browsers that are here, by their ids; kept up to date.
    """
    server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
    # No button asks for it, but any page may: publishing a run through viser's relay.
    server.request_share_url = lambda verbose=True: None
    server.scene.set_up_direction(studio.stage.up)
    start = studio.pose(studio.first_view, LIKELY_CANVAS[0] / LIKELY_CANVAS[1])
    camera = server.initial_camera
    camera.position, camera.look_at, camera.fov = start.position, start.look_at, start.fov
    lock = threading.Lock()

    @server.on_client_connect
    def _(client: viser.ClientHandle) -> None:
        session = Session(client, studio)
        with lock:
            sessions[client.client_id] = session

    @server.on_client_disconnect
    def _(client: viser.ClientHandle) -> None:
        with lock:
            session = sessions.pop(client.client_id, None)
        if session is not None:
            session.stop()


def serve(run: Run, *, host: str, port: int, max_width: int, say: Callable[[str], None]) -> None:
    """Serve a run until Ctrl-C or SIGTERM; a second one ends the process at once.

    For the main thread.

    Args:
        run: what to show.
        host: address to listen on.
        port: likewise.
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
            say(f"{run.params.gaussians.capacity} Gaussians at {address} (Ctrl-C ends)")
            while not asked:
                time.sleep(0.1)
            say("Ending, once what is being compiled is done.")
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
