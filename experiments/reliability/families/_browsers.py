"""Browsers without a screen: they move a camera of the viewer and wait for its pictures."""

from __future__ import annotations

import asyncio
import contextlib
import math
import time
from dataclasses import dataclass, field

import msgspec.msgpack
import viser
import websockets
import zstandard

CANVAS = (320, 200)
# Seconds between a picture and the next move: less than the viewer waits for rest, so that the
# next picture is of the next move.
EVERY_S = 0.2
# No picture may be waited for so long.
MOST_S = 30.0
_PICTURE = b"BackgroundImageMessage"


@dataclass
class Browser:
    """A client that speaks the protocol of the viewer's page.

    Attributes:
        number: decides where it looks.
        reads: False: it sends moves and never reads what comes.
        rude: it leaves without a word, as a browser that is killed.
        latencies: seconds from a move to its picture, and when that came (monotonic).
        lost: how often the server closed the connection; it connects again.
    """

    number: int
    reads: bool = True
    rude: bool = False
    latencies: list[tuple[float, float]] = field(default_factory=list)
    lost: int = 0

    async def look(self, address: str, seconds: float) -> None:
        """Connect, move for some seconds, and leave."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            try:
                await self._connected(address, end)
            except websockets.ConnectionClosed:
                self.lost += 1

    async def _connected(self, address: str, end: float) -> None:
        protocol = websockets.Subprotocol(f"viser-v{viser.__version__}")
        socket = await websockets.connect(
            address.replace("http", "ws", 1),
            subprotocols=[protocol],
            max_size=None,
            max_queue=None if self.reads else 1,
            compression=None,
            ping_interval=None,
        )
        try:
            step = 0
            while time.monotonic() < end:
                begin = time.monotonic()
                await socket.send(_camera(self.number, step))
                step += 1
                if self.reads and await _picture(socket):
                    now = time.monotonic()
                    self.latencies.append((now, now - begin))
                await (_drained(socket) if self.reads else asyncio.sleep(EVERY_S))
        finally:
            if not self.rude:
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(socket.close(), 5)
            socket.transport.abort()


async def _picture(socket: websockets.ClientConnection) -> bool:
    """Read until a picture comes; return whether one came."""
    end = time.monotonic() + MOST_S
    while (left := end - time.monotonic()) > 0:
        try:
            if _holds_picture(await asyncio.wait_for(socket.recv(), left)):
                return True
        except TimeoutError:
            break
    return False


async def _drained(socket: websockets.ClientConnection) -> None:
    """Wait for the next move, and read what comes meanwhile."""
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(EVERY_S):
            while True:
                await socket.recv()


def _holds_picture(data: str | bytes) -> bool:
    """Return whether a window of messages holds a picture (viser: sizes, zstd, buffers)."""
    assert isinstance(data, bytes)
    size, packed = (int.from_bytes(data[k : k + 8], "little") for k in (0, 8))
    plain = zstandard.ZstdDecompressor().decompress(data[16 : 16 + packed], max_output_size=size)
    return _PICTURE in plain


def _camera(number: int, step: int) -> bytes:
    angle = 0.02 * math.sin(0.3 * step + number)
    return msgspec.msgpack.encode(
        {
            "type": "ViewerCameraMessage",
            "wxyz": (math.cos(angle / 2), 0.0, math.sin(angle / 2), 0.0),
            "position": (0.05 * math.sin(step + number), 0.0, 0.0),
            "fov": 0.9,
            "near": 0.01,
            "far": 1000.0,
            "image_height": CANVAS[1],
            "image_width": CANVAS[0],
            "look_at": (0.0, 0.0, 4.0),
            "up_direction": (0.0, -1.0, 0.0),
        }
    )
