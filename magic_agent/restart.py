"""Where an agent goes on: what its spool and the server remember of an earlier life."""

from __future__ import annotations

import asyncio
import logging
from concurrent.futures import Executor
from dataclasses import dataclass

from magic_agent.client import MagicClient
from magic_agent.resume import ResumePoint, ResumeState
from magic_agent.spool import Spool
from magic_core.errors import CorruptData, NotFound, WrongState
from magic_core.submap import Submap
from magic_core.wire import decode_submap, names
from magic_core.wire.records import AgentRegistration

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Restart:
    """How an agent begins."""

    point: ResumePoint
    next_frame: int = 0
    """Number of the first frame to read."""
    state: ResumeState | None = None
    """The earlier life's counters, where they were found."""


async def find_restart(
    spool: Spool,
    client: MagicClient,
    registration: AgentRegistration,
    *,
    session: str,
    agent: str,
    executor: Executor,
) -> Restart:
    """Where to begin: at the beginning, or behind the last finished sub-map.

    Raises WrongState when the spool holds sub-maps that this server cannot take.
    """
    loop = asyncio.get_running_loop()
    known = registration.next_submap_index
    await loop.run_in_executor(executor, _require_own, spool, session, agent)
    pending, newest = spool.pending(), spool.newest()
    needed = pending[0] if pending else (-1 if newest is None else newest) + 1
    if known < needed:
        if pending:
            raise WrongState(
                f"{spool.folder} holds sub-maps from {needed} on, and {registration.agent} has "
                f"{known} on this server; connect to the server that has the others, or give "
                "another --out to start over"
            )
        log.warning("%s has less than %s says: starting over", registration.agent, spool.folder)
        await loop.run_in_executor(executor, spool.clear)
        newest = None
    if newest is None or known > newest + 1:
        return await _from_server(client, known, session=session, agent=agent)
    return await loop.run_in_executor(executor, _from_disk, spool, newest)


def _from_disk(spool: Spool, newest: int) -> Restart:
    memory = _decoded(spool, newest)
    try:
        state = spool.load_state(newest)
    except (CorruptData, NotFound) as error:
        log.warning("going on from sub-map %d alone: %s", newest, error)
        return _behind(memory, newest)
    log.info("going on behind sub-map %d, with frame %d", newest, state.next_frame)
    point = ResumePoint(newest + 1, state.opening, memory)
    return Restart(point, state.next_frame, state)


async def _from_server(client: MagicClient, known: int, *, session: str, agent: str) -> Restart:
    """Behind the newest sub-map that the server has of this agent."""
    if not known:
        return Restart(ResumePoint(0))
    stored = await client.list_submaps(session, agent=agent)
    if not stored:
        return Restart(ResumePoint(known))
    memory = await client.download_submap(stored[-1].name)
    log.info("going on behind sub-map %d, read back from the server", memory.index)
    return _behind(memory, known - 1)


def _behind(memory: Submap | None, newest: int) -> Restart:
    next_frame = 0 if memory is None else memory.trajectory[-1].frame_index + 1
    return Restart(ResumePoint(newest + 1, None, memory), next_frame)


def _decoded(spool: Spool, index: int) -> Submap | None:
    try:
        encoded = spool.load(index)
        return decode_submap(encoded.header, encoded.blobs)
    except CorruptData as error:
        log.warning("%s", error)
        return None


def _require_own(spool: Spool, session: str, agent: str) -> None:
    """Raise WrongState for unsent sub-maps of somebody else; forget what else is not ours."""
    owner = names.agent_name(session, agent)
    newest = spool.newest()
    if newest is None:
        return
    found = spool.load_header(newest).name.rsplit("/submaps/", 1)[0]
    if found == owner:
        return
    if spool.pending():
        raise WrongState(
            f"{spool.folder} holds sub-maps of {found} that were not sent yet; run that agent "
            f"again, or give another --out for {owner}"
        )
    spool.clear()
