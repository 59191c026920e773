"""A TCP proxy that does what networks do: delay, throttle, cut at any byte, stall, fall silent."""

from __future__ import annotations

import asyncio
import contextlib
import random
import socket
from dataclasses import dataclass

_PIECE = 16 << 10


@dataclass(frozen=True, slots=True)
class Weather:
    """What happens to connections."""

    delay_s: float = 0.0
    """Every piece of bytes arrives up to this much later; connections overtake each other."""
    bytes_per_s: float = 0.0
    """Throughput of a connection; 0 for all there is."""
    cut_after: tuple[int, int] | None = None
    """A connection is cut after a number of bytes from this range, wherever that falls."""
    refuse: float = 0.0
    """Share of connections that are closed as soon as they are open."""
    silent: float = 0.0
    """Share of the cuts in which nothing more is forwarded but the connection stays open."""
    cuts: int = 0
    """After so many cuts the connections last."""


@dataclass(slots=True)
class Traffic:
    """What the proxy saw."""

    connections: int = 0
    refused: int = 0
    cuts: int = 0
    silences: int = 0
    bytes_up: int = 0
    """Bytes from clients that were handed to the server."""


class Proxy:
    """Stands between clients and one server.

    async with Proxy(server_address, weather, rng) as proxy: connect to proxy.address
    """

    def __init__(self, target: str, weather: Weather, rng: random.Random) -> None:
        self.traffic = Traffic()
        self._host, port = target.rsplit(":", 1)
        self._port = int(port)
        self._weather = weather
        self._rng = rng
        self._server: asyncio.Server | None = None
        self._connections: set[asyncio.Task[None]] = set()

    @property
    def address(self) -> str:
        """Where clients connect."""
        assert self._server is not None
        return f"127.0.0.1:{self._server.sockets[0].getsockname()[1]}"

    async def __aenter__(self) -> Proxy:
        self._server = await asyncio.start_server(self._accept, "127.0.0.1", 0)
        return self

    async def __aexit__(self, *_: object) -> None:
        assert self._server is not None
        self._server.close()
        for task in list(self._connections):
            task.cancel()
        await asyncio.gather(*self._connections, return_exceptions=True)

    async def _accept(self, up: asyncio.StreamReader, down: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._connections.add(task)
        try:
            await self._carry(up, down)
        except (OSError, asyncio.CancelledError):
            pass  # either end went away, or the test is over
        finally:
            self._connections.discard(task)
            _slam(down)

    async def _carry(self, client: asyncio.StreamReader, back: asyncio.StreamWriter) -> None:
        traffic, weather = self.traffic, self._weather
        traffic.connections += 1
        if self._rng.random() < weather.refuse:
            traffic.refused += 1
            return
        server, forth = await asyncio.open_connection(self._host, self._port)
        link = _Link(self._budget())
        try:
            async with asyncio.TaskGroup() as group:
                group.create_task(self._pump(client, forth, link, counted=True))
                group.create_task(self._pump(server, back, link, counted=False))
        except* OSError:
            pass  # one end is gone, and the other is sent away
        except* _Cut:
            if self._rng.random() < weather.silent:
                traffic.silences += 1
                await asyncio.Event().wait()  # open, and dead: only keepalive finds out
        finally:
            _slam(forth)

    def _budget(self) -> int | None:
        """Bytes that a new connection may carry."""
        weather = self._weather
        if weather.cut_after is None or self.traffic.cuts >= weather.cuts:
            return None
        return self._rng.randint(*weather.cut_after)

    def _may_cut(self, link: _Link) -> bool:
        """Whether this connection ends now: others may have had the last of the cuts meanwhile."""
        if link.cut:
            return True
        if self.traffic.cuts >= self._weather.cuts:
            link.lasts()
            return False
        self.traffic.cuts += 1
        link.cut = True
        return True

    async def _pump(
        self,
        source: asyncio.StreamReader,
        sink: asyncio.StreamWriter,
        link: _Link,
        *,
        counted: bool,
    ) -> None:
        weather = self._weather
        while data := await source.read(_PIECE):
            if weather.delay_s:
                await asyncio.sleep(self._rng.uniform(0.0, weather.delay_s))
            if weather.bytes_per_s:
                await asyncio.sleep(len(data) / weather.bytes_per_s)
            passed = link.take(data)
            if len(passed) < len(data) and not self._may_cut(link):
                passed = data
            sink.write(passed)
            await sink.drain()
            if counted:
                self.traffic.bytes_up += len(passed)
            if len(passed) < len(data):
                raise _Cut
        with contextlib.suppress(OSError):
            sink.write_eof()


class _Cut(Exception):
    """The connection has carried what it may."""


class _Link:
    """One connection's two directions."""

    def __init__(self, budget: int | None) -> None:
        self._budget = budget
        self.cut = False

    def lasts(self) -> None:
        """It carries whatever comes."""
        self._budget = None

    def take(self, data: bytes) -> bytes:
        """As much of the data as still passes."""
        if self._budget is None:
            return data
        passed = data[: self._budget]
        self._budget -= len(passed)
        return passed


def _slam(writer: asyncio.StreamWriter) -> None:
    """Close with a reset, as a lost link looks from one end."""
    with contextlib.suppress(OSError):
        found = writer.get_extra_info("socket")
        if found is not None:
            found.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\x01\0\0\0\0\0\0\0")
    writer.transport.abort()
