"""What an engine for heavy work must do. The rest of the server knows no more of it than this.

A job is a module-level function of this project and plain arguments: small arrays, messages as
bytes, stored blobs, and paths of files under the server's data folder, which a worker reads and
writes where it shares that folder. It may
run twice: an engine tries it again when a worker is lost, so that a job leaves nothing behind that
a second try would stumble over.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, TypeVar

T = TypeVar("T")

JobObserver = Callable[[str, str, float, float], None]
"""Called with a job's name, its outcome (ok, failed or died), and the seconds that it waited for a
worker and that it ran; both are 0 where they are not known."""


class JobExecutor(Protocol):
    """Runs functions elsewhere. Used by the coroutines of one event loop."""

    @property
    def workers(self) -> int:
        """How many jobs a caller that has many should have open at a time."""
        ...

    @property
    def slots(self) -> int:
        """How many jobs could run at once now."""
        ...

    @property
    def waiting(self) -> int:
        """Jobs that wait for a worker."""
        ...

    @property
    def shares_folder(self) -> bool:
        """Whether jobs read and write the server's data folder; else a bucket is all they share."""
        ...

    async def start(self) -> None:
        """Be ready for jobs. The server's data folder exists."""
        ...

    async def run(self, function: Callable[..., T], /, *arguments: Any) -> T:
        """The function's result, or the error it raised.

        Cancelling the call gives the job up. Unavailable when workers died of it, or when the
        engine is closing.
        """
        ...

    async def close(self) -> None:
        """End the workers or let them go; jobs under way are lost."""
        ...
