"""A broken connection is an error of ours; a cancellation is one only when somebody cancelled."""

from __future__ import annotations

import asyncio

import pytest

from magic_agent.client import ClientConfig, MagicClient
from magic_core.errors import Unavailable

NOBODY = ClientConfig(attempts=2, backoff_s=0.01)


async def test_what_grpc_calls_cancelled_when_a_connection_breaks_is_tried_again() -> None:
    client = MagicClient("127.0.0.1:1", NOBODY)
    tries = 0

    async def attempt() -> None:
        nonlocal tries
        tries += 1
        raise asyncio.CancelledError

    with pytest.raises(Unavailable, match="connection broke"):
        await client.retried(attempt)
    assert tries == 2
    await client.close()


async def test_a_caller_that_is_cancelled_stays_cancelled() -> None:
    client = MagicClient("127.0.0.1:1", NOBODY)
    waiting = asyncio.create_task(client.retried(asyncio.Event().wait))
    await asyncio.sleep(0)
    waiting.cancel()
    with pytest.raises(asyncio.CancelledError):
        await waiting
    with pytest.raises(TimeoutError):
        async with asyncio.timeout(0.01):
            await client.retried(asyncio.Event().wait)
    await client.close()
