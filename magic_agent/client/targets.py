"""The servers that may answer, and the one that calls go to at present."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from typing import Any

import grpc.aio

from magic_core.errors import ConfigError, HeldElsewhere, MagicError, Unavailable
from magic_core.wire import ClientCredentials, Transport, client_options, open_channel

_ONE_NAME = ("ipv4:", "ipv6:", "unix:")  # gRPC's own lists of addresses are one server


class Targets:
    """A channel for generated stubs whose calls go to one of several servers.

    A server that works on something else names the one to ask; one that does not answer is left
    for the next. Connections are opened when they are first needed.
    """

    def __init__(
        self, targets: str, *, credentials: ClientCredentials, transport: Transport
    ) -> None:
        """`targets`: HOST:PORT, or several with commas between them."""
        whole = targets.startswith(_ONE_NAME)
        self._names = [targets] if whole else [name.strip() for name in targets.split(",")]
        if not all(self._names):
            raise ConfigError.field("server", f"{targets!r}: expected HOST:PORT[,HOST:PORT...]")
        self._credentials = credentials
        self._options = client_options(transport)
        self._channels: dict[str, Any] = {}
        self._left: str | None = None
        self.current = self._names[0]
        self._opened(self.current)  # a setting that is wrong is told now

    @property
    def several(self) -> bool:
        """Whether there is another server to ask."""
        return len(self._names) > 1

    def unary_unary(self, *arguments: Any, **settings: Any) -> Callable[..., Any]:
        return self._switched("unary_unary", *arguments, **settings)

    def unary_stream(self, *arguments: Any, **settings: Any) -> Callable[..., Any]:
        return self._switched("unary_stream", *arguments, **settings)

    def stream_unary(self, *arguments: Any, **settings: Any) -> Callable[..., Any]:
        return self._switched("stream_unary", *arguments, **settings)

    def stream_stream(self, *arguments: Any, **settings: Any) -> Callable[..., Any]:
        return self._switched("stream_stream", *arguments, **settings)

    def turn(self, error: MagicError) -> bool:
        """Go to another server where an error says so; whether it can be asked at once."""
        if isinstance(error, HeldElsewhere):
            if not error.holder:
                return False
            # Who was left because it did not answer is not asked again without a pause.
            at_once = error.holder not in (self._left, self.current)
            if error.holder not in self._names:
                self._names.append(error.holder)
            self._left, self.current = None, error.holder
            return at_once
        if isinstance(error, Unavailable) and self.several:
            place = self._names.index(self.current)
            self._left, self.current = self.current, self._names[(place + 1) % len(self._names)]
        return False

    async def ready(self) -> None:
        """Wait until one of the servers answers; calls go to the first that does."""
        waiting = {
            asyncio.ensure_future(self._opened(name).channel.channel_ready()): name
            for name in self._names
        }
        try:
            done, _ = await asyncio.wait(waiting, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for one in waiting:
                one.cancel()
            await asyncio.gather(*waiting, return_exceptions=True)
        ready = {waiting[one] for one in done}
        self.current = next(name for name in self._names if name in ready)

    @property
    def channel(self) -> grpc.aio.Channel:
        """The connection to the current server."""
        return self._opened(self.current).channel

    async def close(self) -> None:
        """Close every connection; calls under way are cancelled."""
        for opened in self._channels.values():
            with contextlib.suppress(asyncio.CancelledError):
                await opened.channel.close(grace=None)

    def _opened(self, name: str) -> Any:
        if name not in self._channels:
            self._channels[name] = open_channel(name, self._credentials, self._options)
        return self._channels[name]

    def _switched(self, kind: str, *arguments: Any, **settings: Any) -> Callable[..., Any]:
        methods: dict[str, Callable[..., Any]] = {}

        def call(*given: Any, **named: Any) -> Any:
            name = self.current
            if name not in methods:
                methods[name] = getattr(self._opened(name), kind)(*arguments, **settings)
            return methods[name](*given, **named)

        return call
