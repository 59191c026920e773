"""What signals mean: the first SIGTERM drains, the second ends at once, SIGHUP reloads."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import signal
from collections.abc import Callable, Iterator

logger = logging.getLogger(__name__)

_STOPPING = (signal.SIGINT, signal.SIGTERM)


@contextlib.contextmanager
def stop_signals(*, on_reload: Callable[[], object]) -> Iterator[asyncio.Event]:
    """Yields the event that the first SIGINT or SIGTERM sets.

    `on_reload` is called on a thread for every SIGHUP; what it raises is logged.
    """
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()

    def end(number: int) -> None:
        if stop.is_set():
            # Nothing is lost: whatever was acknowledged is on disk, as after a kill.
            logger.warning("told to stop a second time; ending at once")
            logging.shutdown()
            os._exit(128 + number)
        logger.info("draining; a second signal ends at once")
        stop.set()

    def reload() -> None:
        try:
            on_reload()
        except Exception as error:
            logger.error("nothing was reloaded: %s", error)

    for number in _STOPPING:
        loop.add_signal_handler(number, end, number)
    loop.add_signal_handler(signal.SIGHUP, loop.run_in_executor, None, reload)
    try:
        yield stop
    finally:
        for number in (*_STOPPING, signal.SIGHUP):
            loop.remove_signal_handler(number)
