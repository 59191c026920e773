"""What the page shows, kept up to date through the client: poll, download what is new, draw.

The viewer is a client of its own process. It asks at a bounded rate, downloads each sub-map once,
and the server coalesces revisions, so that watching never slows a run.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable

from magic_agent.client import MagicClient
from magic_cli.viewer.model import SessionView, SubmapView
from magic_core.errors import DeadlineExceeded, NotFound, Unavailable
from magic_core.wire import names

log = logging.getLogger(__name__)

Draw = Callable[[SessionView], None]
_DOWNLOADS_PER_ROUND = 4


class Feed:
    """Keeps a SessionView equal to what the server has."""

    def __init__(
        self, client: MagicClient, *, session: str | None, draw: Draw, interval_s: float
    ) -> None:
        self._client = client
        self._session = session
        self._draw = draw
        self._interval_s = interval_s
        self._view: SessionView | None = None
        self._maps: dict[str, str] = {}

    async def run(self) -> None:
        """Follow the session until cancelled; waits out a server that is away."""
        while True:
            try:
                await self.refresh()
            except (Unavailable, DeadlineExceeded) as error:
                log.warning("the server is away, trying again: %s", error)
            except NotFound as error:
                log.info("nothing to show yet: %s", error)
            await asyncio.sleep(self._interval_s)

    async def complete(self) -> None:
        """Follow the session until everything that the server has now is here."""
        while not await self.refresh():
            pass

    async def refresh(self) -> bool:
        """One round; False when more is waiting to be downloaded."""
        view = await self._current_view()
        if view is None:
            return True
        view.snapshot = await self._client.get_corrected_poses(view.session)
        view.agents = await self._client.list_agents(view.session)
        missing = [name for name in view.snapshot.poses if name not in view.submaps]
        for name in missing[:_DOWNLOADS_PER_ROUND]:
            submap = await self._client.download_submap(name)
            view.submaps[name] = await asyncio.to_thread(SubmapView.of, submap)
        for name in view.submaps.keys() - view.snapshot.poses.keys():
            del view.submaps[name]
        view.loops = (await self._client.list_loops(view.session)).candidates
        await self._newest_maps(view)
        await asyncio.to_thread(self._draw, view)
        return len(missing) <= _DOWNLOADS_PER_ROUND

    async def _current_view(self) -> SessionView | None:
        """The session's view; without a name it is the session that was created last."""
        if self._view is None:
            session = self._session
            if session is None:
                sessions = await self._client.list_sessions()
                if not sessions:
                    return None
                session = names.parse_session(sessions[-1].name)
            self._view = SessionView(session)
        return self._view

    async def _newest_maps(self, view: SessionView) -> None:
        """The newest merged map of each component of the present solution."""
        assert view.snapshot is not None
        newest = {
            operation.result.component: operation.result.name
            for operation in await self._client.list_operations(view.session)
            if operation.result is not None
        }
        present = {component.id for component in view.snapshot.components}
        for component, name in newest.items():
            if component in present and self._maps.get(component) != name:
                view.merged[component] = await self._client.get_global_map(name)
                self._maps[component] = name
        for component in view.merged.keys() - present:
            del view.merged[component]
