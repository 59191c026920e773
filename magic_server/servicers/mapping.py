"""MappingService: converts, calls and converts back."""

from __future__ import annotations

import asyncio
import functools
import time
from collections.abc import AsyncIterator
from concurrent.futures import Executor

import grpc.aio
import numpy as np
from magicslam.v1 import mapping_service_pb2 as mapping_pb
from magicslam.v1 import mapping_service_pb2_grpc as mapping_grpc
from magicslam.v1 import submap_pb2

from magic_core.errors import FieldViolation, InvalidInput
from magic_core.geometry.seams import Seams
from magic_core.wire import MAX_CHUNK_BYTES, convert, geometry, names, records
from magic_core.wire.header_check import request_id_problem
from magic_core.wire.submap import decode_trajectory
from magic_server.config import ServerConfig
from magic_server.coordinator import SessionCoordinator
from magic_server.localizing import Localizer
from magic_server.quotas import Quotas
from magic_server.receiving import SubmapReceiver
from magic_server.seams import seams_of
from magic_server.servicers.fields import check_request_id, page_limit, page_start, token_of
from magic_server.sessions import Sessions
from magic_server.store import Asked, Store, require_model

Context = grpc.aio.ServicerContext
MAX_WAIT_S = 60.0


class MappingServicer(mapping_grpc.MappingServiceServicer):
    """What agents and readers of corrected poses call."""

    def __init__(
        self,
        store: Store,
        sessions: Sessions,
        *,
        receiver: SubmapReceiver,
        localizer: Localizer,
        quotas: Quotas,
        threads: Executor,
        config: ServerConfig,
    ) -> None:
        self._store = store
        self._sessions = sessions
        self._receiver = receiver
        self._localizer = localizer
        self._quotas = quotas
        self._threads = threads
        self._config = config

    async def RegisterAgent(  # noqa: N802
        self, request: mapping_pb.RegisterAgentRequest, context: Context
    ) -> mapping_pb.RegisterAgentResponse:
        session, agent = names.parse_agent(request.agent, field="agent")
        _check_registration(request, self._config.limits.submap.max_descriptor_dimension)
        await self._quotas.registration(session, agent)
        asked = Asked.of(request, request_id=request.request_id, now=time.time())
        entered = await self._store.agents.register(
            session,
            agent,
            model_id=request.descriptor_model_id,
            dimension=request.descriptor_dimension,
            asked=asked,
        )
        await self._sessions.coordinator(entered.agent.session)
        return mapping_pb.RegisterAgentResponse(
            agent=request.agent,
            next_submap_index=entered.next_submap_index,
            resumed=entered.resumed,
            revision=entered.revision,
            max_submap_bytes=self._config.limits.submap.max_bytes,
            max_chunk_bytes=MAX_CHUNK_BYTES,
        )

    async def SubmitSubmap(  # noqa: N802
        self,
        request_iterator: AsyncIterator[mapping_pb.SubmitSubmapRequest],
        context: Context,
    ) -> mapping_pb.SubmitSubmapResponse:
        name, received = await self._receiver.receive(
            aiter(request_iterator), on_stored=self._sessions.submap_stored
        )
        return mapping_pb.SubmitSubmapResponse(
            submap=name,
            received_at=convert.timestamp_to_proto(convert.moment(received.received_at)),
            stored_bytes=received.stored_bytes,
            duplicate=received.duplicate,
        )

    async def ResumeUpload(  # noqa: N802
        self, request: mapping_pb.ResumeUploadRequest, context: Context
    ) -> mapping_pb.ResumeUploadResponse:
        check_request_id(request.request_id)
        found = await self._receiver.resumption(request.submap, request.request_id)
        return mapping_pb.ResumeUploadResponse(
            submap=request.submap,
            blob_index=found.blob_index,
            offset=found.offset,
            durable_bytes=found.durable_bytes,
            stored=found.stored,
        )

    async def FinishAgent(  # noqa: N802
        self, request: mapping_pb.FinishAgentRequest, context: Context
    ) -> mapping_pb.FinishAgentResponse:
        session, agent = names.parse_agent(request.agent, field="agent")
        check_request_id(request.request_id)
        asked = Asked.of(request, request_id=request.request_id, now=time.time())
        count = await self._store.agents.finish(session, agent, asked=asked)
        return mapping_pb.FinishAgentResponse(agent=request.agent, submap_count=count)

    async def QueryLoops(  # noqa: N802
        self, request: mapping_pb.QueryLoopsRequest, context: Context
    ) -> mapping_pb.QueryLoopsResponse:
        if not -1.0 <= request.min_similarity <= 1.0:
            raise InvalidInput.field("min_similarity", "expected -1 to 1")
        if request.max_candidates > 1000:
            raise InvalidInput.field("max_candidates", "expected 0 to 1000")
        match request.WhichOneof("query"):
            case "submap":
                candidates, coordinator = await self._recorded(request)
            case "image_descriptor":
                candidates, coordinator = await self._nearest(request)
            case _:
                raise InvalidInput.field("query", "give `submap` or `image_descriptor`")
        return mapping_pb.QueryLoopsResponse(
            candidates=await self._loop_messages(candidates), revision=coordinator.board.revision
        )

    async def ListLoops(  # noqa: N802
        self, request: mapping_pb.ListLoopsRequest, context: Context
    ) -> mapping_pb.ListLoopsResponse:
        coordinator = await self._coordinator(request.session)
        found, following = await self._store.loops.page(
            coordinator.session,
            after=page_start(request.page_token),
            limit=page_limit(request.page_size, default=500),
        )
        return mapping_pb.ListLoopsResponse(
            candidates=await self._loop_messages(found),
            next_page_token=token_of(following),
            revision=coordinator.board.revision,
        )

    async def GetCorrectedPoses(  # noqa: N802
        self, request: mapping_pb.GetCorrectedPosesRequest, context: Context
    ) -> mapping_pb.GetCorrectedPosesResponse:
        coordinator = await self._coordinator(request.session)
        agent = await self._agent_of(coordinator, request.agent)
        return mapping_pb.GetCorrectedPosesResponse(snapshot=_snapshot(coordinator, agent))

    async def WatchCorrectedPoses(  # noqa: N802
        self, request: mapping_pb.WatchCorrectedPosesRequest, context: Context
    ) -> AsyncIterator[mapping_pb.WatchCorrectedPosesResponse]:
        coordinator = await self._coordinator(request.session)
        agent = await self._agent_of(coordinator, request.agent)
        revision = request.after_revision
        while True:
            await coordinator.board.newer_than(revision)
            snapshot = _snapshot(coordinator, agent)
            revision = snapshot.revision
            yield mapping_pb.WatchCorrectedPosesResponse(snapshot=snapshot)

    async def GetTrajectory(  # noqa: N802
        self, request: mapping_pb.GetTrajectoryRequest, context: Context
    ) -> AsyncIterator[mapping_pb.GetTrajectoryResponse]:
        session, agent = names.parse_agent(request.agent, field="agent")
        if not 0.0 <= request.wait_s <= MAX_WAIT_S:
            raise InvalidInput.field("wait_s", f"expected 0 to {MAX_WAIT_S:g} seconds")
        row = await self._store.agents.agent(session, agent)
        coordinator = await self._sessions.coordinator(row.session)
        await coordinator.placed(request.agent, timeout_s=request.wait_s)
        snapshot = coordinator.board.of_agent(request.agent)
        loop = asyncio.get_running_loop()
        odometry_of = coordinator.graph.odometry_of
        seams = await loop.run_in_executor(self._threads, seams_of, snapshot.poses, odometry_of)
        for pose in snapshot.poses:
            index = names.parse_submap(pose.submap)[2]
            stored = await self._store.submaps.stored(row.session, agent, index)
            part = functools.partial(
                _trajectory_part, pose, stored.header, snapshot.revision, seams=seams[pose.submap]
            )
            yield await loop.run_in_executor(self._threads, part)

    async def Localize(  # noqa: N802
        self, request: mapping_pb.LocalizeRequest, context: Context
    ) -> mapping_pb.LocalizeResponse:
        coordinator = await self._coordinator(request.session)
        found = await self._localizer.localize(request, coordinator)
        return convert.localization_to_proto(found)

    async def _loop_messages(
        self, loops: list[records.LoopCandidate]
    ) -> list[mapping_pb.LoopCandidate]:
        """Messages of many candidates, made on a thread: a thousand take longer than 50 ms."""
        return await asyncio.get_running_loop().run_in_executor(
            self._threads, lambda: [convert.loop_to_proto(loop) for loop in loops]
        )

    async def _coordinator(self, session: str) -> SessionCoordinator:
        return await self._sessions.named(names.parse_session(session, field="session"))

    async def _agent_of(self, coordinator: SessionCoordinator, agent: str) -> str:
        """The agent's resource name, checked to exist in the session; empty for all agents."""
        if agent:
            session, name = names.parse_agent(agent, field="agent")
            if session != coordinator.session.name:
                raise InvalidInput.field("agent", f"{agent} is not in the session asked for")
            await self._store.agents.agent(session, name)
        return agent

    async def _recorded(
        self, request: mapping_pb.QueryLoopsRequest
    ) -> tuple[list[records.LoopCandidate], SessionCoordinator]:
        session, agent, index = names.parse_submap(request.submap, field="submap")
        coordinator = await self._sessions.named(session)
        await self._store.submaps.info(coordinator.session, agent, index)
        found = await self._store.loops.of_submap(coordinator.session, request.submap)
        found = [loop for loop in found if loop.similarity >= request.min_similarity]
        return found[: request.max_candidates or None], coordinator

    async def _nearest(
        self, request: mapping_pb.QueryLoopsRequest
    ) -> tuple[list[records.LoopCandidate], SessionCoordinator]:
        coordinator = await self._coordinator(request.session)
        limit = self._config.limits.submap.max_descriptor_dimension
        if problem := geometry.descriptor_problem(request.image_descriptor, max_dimension=limit):
            raise InvalidInput.field("image_descriptor", problem)
        vector = np.array(request.image_descriptor.vector, dtype=np.float32)
        require_model(coordinator.session, request.image_descriptor.model_id, len(vector))
        found = await coordinator.nearest(
            vector,
            count=request.max_candidates or 10,
            min_similarity=request.min_similarity,
        )
        return found, coordinator


def _check_registration(request: mapping_pb.RegisterAgentRequest, max_dimension: int) -> None:
    found = []
    if problem := request_id_problem(request.request_id):
        found.append(FieldViolation("request_id", problem))
    if problem := request_id_problem(request.descriptor_model_id):
        found.append(FieldViolation("descriptor_model_id", problem))
    if not 1 <= request.descriptor_dimension <= max_dimension:
        rule = f"{request.descriptor_dimension}, expected 1 to {max_dimension}"
        found.append(FieldViolation("descriptor_dimension", rule))
    if found:
        raise InvalidInput(f"{found[0].field}: {found[0].description}", violations=tuple(found))


def _snapshot(coordinator: SessionCoordinator, agent: str) -> mapping_pb.PoseSnapshot:
    return coordinator.board.of_agent(agent) if agent else coordinator.board.snapshot


def _trajectory_part(
    pose: mapping_pb.CorrectedPose, header: bytes, revision: int, *, seams: Seams
) -> mapping_pb.GetTrajectoryResponse:
    """The corrected frames of one sub-map, with what its seams ask of them."""
    world_from_anchor = geometry.pose_from_proto(pose.world_from_anchor)
    tracked = decode_trajectory(submap_pb2.SubmapHeader.FromString(header))
    anchor_from_cameras = seams.spread([frame.anchor_from_camera for frame in tracked])
    frames = tuple(
        records.CorrectedFrame(frame.frame_index, frame.timestamp_s, camera, frame.lost)
        for frame, camera in zip(tracked, world_from_anchor @ anchor_from_cameras, strict=True)
    )
    return convert.trajectory_part_to_proto(
        records.TrajectoryPart(pose.submap, pose.component, revision, frames)
    )
