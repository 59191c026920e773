"""Calls of MappingService: agents, sub-maps, loops and corrected poses."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from typing import Any

from magicslam.v1 import mapping_service_pb2 as mapping_pb

from magic_agent.client.connection import Connection, new_id
from magic_core.errors import DeadlineExceeded, MagicError
from magic_core.geometry import Camera
from magic_core.submap import Descriptor
from magic_core.wire import (
    convert,
    geometry,
    images,
    names,
    records,
)


class MappingCalls(Connection):
    """What agents and readers of corrected poses call."""

    async def register_agent(
        self,
        session: str,
        agent: str,
        *,
        model_id: str,
        dimension: int,
        request_id: str | None = None,
    ) -> records.AgentRegistration:
        """Enter a session, or resume in it; the session begins with its first agent.

        Raises DescriptorModelMismatch when the session is pinned to another image encoder,
        WrongState when the agent has finished.
        """
        request = mapping_pb.RegisterAgentRequest(
            agent=names.agent_name(session, agent),
            request_id=request_id or new_id(),
            descriptor_model_id=model_id,
            descriptor_dimension=dimension,
        )
        answer = await self.idempotent(self.mapping_stub.RegisterAgent, request)
        return records.AgentRegistration(
            agent=answer.agent,
            next_submap_index=answer.next_submap_index,
            resumed=answer.resumed,
            revision=answer.revision,
            max_submap_bytes=answer.max_submap_bytes,
            max_chunk_bytes=answer.max_chunk_bytes,
        )

    async def finish_agent(self, session: str, agent: str, *, request_id: str | None = None) -> int:
        """Say that an agent will send no more; returns its number of stored sub-maps."""
        request = mapping_pb.FinishAgentRequest(
            agent=names.agent_name(session, agent), request_id=request_id or new_id()
        )
        return (await self.idempotent(self.mapping_stub.FinishAgent, request)).submap_count

    async def query_loops(
        self,
        query: str | Descriptor,
        *,
        session: str | None = None,
        max_candidates: int = 0,
        min_similarity: float = 0.0,
    ) -> records.LoopAnswer:
        """Where else a place was seen, most similar first.

        `query` is the resource name of a stored sub-map, which gives its recorded candidates with
        their verdicts, or a raw descriptor, which needs `session` and gives the nearest sub-maps.
        """
        request = mapping_pb.QueryLoopsRequest(
            session=names.session_name(session) if session else "",
            max_candidates=max_candidates,
            min_similarity=min_similarity,
        )
        if isinstance(query, str):
            request.submap = query
        else:
            request.image_descriptor.CopyFrom(geometry.descriptor_to_proto(query))
        answer = await self.idempotent(self.mapping_stub.QueryLoops, request)
        candidates = tuple(convert.loop_from_proto(c) for c in answer.candidates)
        return records.LoopAnswer(candidates, answer.revision)

    async def list_loops(self, session: str) -> records.LoopAnswer:
        """Every loop candidate of a session, oldest first."""
        request = mapping_pb.ListLoopsRequest(session=names.session_name(session))
        found: list[records.LoopCandidate] = []
        revision = 0
        async for page in self.pages(self.mapping_stub.ListLoops, request):
            found.extend(convert.loop_from_proto(c) for c in page.candidates)
            revision = page.revision
        return records.LoopAnswer(tuple(found), revision)

    async def get_corrected_poses(
        self, session: str, *, agent: str | None = None
    ) -> records.PoseSnapshot:
        """The newest corrected anchor poses, of one agent where one is named."""
        request = mapping_pb.GetCorrectedPosesRequest(
            session=names.session_name(session), agent=_agent_or_empty(session, agent)
        )
        answer = await self.idempotent(self.mapping_stub.GetCorrectedPoses, request)
        return convert.snapshot_from_proto(answer.snapshot)

    async def watch_corrected_poses(
        self, session: str, *, agent: str | None = None, after_revision: int = 0
    ) -> AsyncIterator[records.PoseSnapshot]:
        """Every new solution from `after_revision` on, coalesced to the newest.

        A broken stream is opened again behind the last revision seen, for as long as the server
        can be reached within the configured attempts. Ends when the caller stops iterating.
        """
        failures = 0
        while True:
            request = mapping_pb.WatchCorrectedPosesRequest(
                session=names.session_name(session),
                agent=_agent_or_empty(session, agent),
                after_revision=after_revision,
            )
            timeout = self.config.watch_timeout_s
            call = self.mapping_stub.WatchCorrectedPoses(request, timeout=timeout)
            try:
                async for answer in self._watched(call):
                    failures = 0
                    after_revision = answer.snapshot.revision
                    yield convert.snapshot_from_proto(answer.snapshot)
            except MagicError as error:
                if not isinstance(error, DeadlineExceeded):
                    await self.pause_or_raise(error, failures)
                    failures += 1
            else:
                await asyncio.sleep(self.config.backoff_s)
            finally:
                call.cancel()

    async def _watched(self, call: Any) -> AsyncIterator[mapping_pb.WatchCorrectedPosesResponse]:
        """The answers of a call, with our errors."""
        answers = aiter(call)
        while True:
            with self.own_errors():
                answer = await anext(answers, None)
            if answer is None:
                return
            yield answer

    async def get_trajectory(
        self, session: str, agent: str, *, wait_s: float = 30.0
    ) -> tuple[records.TrajectoryPart, ...]:
        """The corrected camera pose of every frame of an agent, one part per sub-map.

        Waits up to `wait_s` (at most 60) for a solution that holds all the agent has stored.
        """
        request = mapping_pb.GetTrajectoryRequest(
            agent=names.agent_name(session, agent), wait_s=wait_s
        )

        async def attempt() -> list[mapping_pb.GetTrajectoryResponse]:
            call = self.mapping_stub.GetTrajectory(request, timeout=self.config.download_timeout_s)
            return [message async for message in call]

        messages = await self.retried(attempt)
        return tuple(convert.trajectory_part_from_proto(message) for message in messages)

    async def localize(
        self, session: str, *, camera: Camera, colour: Any, depth: Any, descriptor: Descriptor
    ) -> records.Localization:
        """The pose of an RGB-D image in the stored map.

        `colour` (h, w, 3) uint8 RGB, `depth` (h, w) float32 metres, `descriptor` of the image by
        the session's model. Raises NotLocalized, with the sub-maps that were tried and why each
        was refused, when the image fits no place.
        """
        request = mapping_pb.LocalizeRequest(
            session=names.session_name(session),
            camera=geometry.camera_to_proto(camera),
            colour=await asyncio.to_thread(images.encode_colour_jpeg, colour),
            colour_media_type=images.JPEG,
            depth_png=await asyncio.to_thread(images.encode_depth_png, depth),
            metres_per_unit=0.001,
            image_descriptor=geometry.descriptor_to_proto(descriptor),
        )
        answer = await self.idempotent(
            self.mapping_stub.Localize, request, timeout_s=self.config.localize_timeout_s
        )
        return convert.localization_from_proto(answer)


def _agent_or_empty(session: str, agent: str | None) -> str:
    return names.agent_name(session, agent) if agent else ""
