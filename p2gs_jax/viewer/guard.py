"""Who may talk to the viewer: pages of its own address, and from outside only with a token.

A page of any other site that is open in the same browser could otherwise connect to a port of this
machine (WebSockets know no same-origin policy, RFC 6455, 10.2), also by a name of its own that it
lets point here. viser has no hook for this; what it gives to the `websockets` library is wrapped
while it starts.
"""

from __future__ import annotations

import hmac
import http
import ipaddress
import secrets
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

import websockets.asyncio.server as websocket_server
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

COOKIE, QUERY = "p2gs_jax_token", "token"
_STARTING = threading.Lock()
_LOOPBACK_NAMES = ("localhost", "127.0.0.1", "::1")

Hook = Callable[[ServerConnection, Request], Response | None]


@dataclass(frozen=True)
class Guard:
    """What a request needs.

    Attributes:
        hosts: names by which this machine may be called; None: any.
        token: that has to be in the address, or in the cookie that is set then; None: none.
    """

    hosts: frozenset[str] | None
    token: str | None = None

    def refusal(self, request: Request) -> str | None:
        """Return why a request is refused, or None."""
        host = request.headers.get("Host", "")
        if self.hosts is not None and _name(host) not in self.hosts:
            return "This viewer does not answer to that name."
        origin = request.headers.get("Origin")
        if origin is not None and origin.lower().partition("://")[2] != host.lower():
            return "This viewer answers only to its own page."
        if self.token is not None and not any(
            hmac.compare_digest(said.encode(), self.token.encode()) for said in _tokens(request)
        ):
            return "Open the whole address that `p2gs-jax view` printed, with its token."
        return None


def guard_of(host: str) -> Guard:
    """Return the guard of an address to listen on: with a token where others can reach it."""
    if is_loopback(host):
        return Guard(frozenset({*_LOOPBACK_NAMES, host.lower()}))
    return Guard(None, secrets.token_urlsafe(16))


def is_loopback(host: str) -> bool:
    """Return whether only this machine reaches an address."""
    try:
        found = socket.getaddrinfo(host, None, flags=socket.AI_PASSIVE)
    except (OSError, UnicodeError):
        return False
    addresses = [str(address[0]).partition("%")[0] for *_, address in found]
    return bool(host) and all(ipaddress.ip_address(a).is_loopback for a in addresses)


@contextmanager
def guarded(guard: Guard) -> Iterator[None]:
    """Let a guard stand before every server of `websockets` that starts in a `with` block."""
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
        answer = None if inner is None else inner(connection, request)
        if answer is not None and guard.token is not None:
            answer.headers["Set-Cookie"] = f"{COOKIE}={guard.token}; HttpOnly; SameSite=Strict"
            answer.headers["Referrer-Policy"] = "no-referrer"
        return answer

    return process


def _name(host: str) -> str:
    """Return a Host header without its port."""
    try:
        return (urlsplit(f"//{host}").hostname or "").lower()
    except ValueError:
        return ""


def _tokens(request: Request) -> list[str]:
    """Return the tokens that a request carries."""
    found = parse_qs(request.path.partition("?")[2]).get(QUERY, [])
    try:
        for header in request.headers.get_all("Cookie"):
            cookie = SimpleCookie(header).get(COOKIE)
            found = [*found, cookie.value] if cookie is not None else found
    except CookieError:
        pass
    return found
