"""One agent: frames in, sub-maps out, corrected poses back; asyncio around the local engine.

The event loop only moves things: frames are read, tracked, mapped and encoded on executors. A slow
or absent server never stops tracking, and a slow tracker holds back the reader through a bounded
queue. With `rate_hz` the source is a live camera that does not wait: mapping gives way first, then
frames are dropped (see `pace`), and the tally says what was left out.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from magic_agent.client import MagicClient
from magic_agent.config import AgentConfig
from magic_agent.frame_report import FrameReport
from magic_agent.odometry import Opening
from magic_agent.pace import Pace
from magic_agent.places import DescriptorModel
from magic_agent.places.keyframes import with_described_keyframes
from magic_agent.restart import Restart, find_restart
from magic_agent.resume import ResumePoint, ResumeState
from magic_agent.slam import FrameResult, LocalSlam
from magic_agent.spool import Spool
from magic_agent.tally import Tally
from magic_agent.uplink import Finished, Uplink
from magic_agent.warmup import warm_up_slam
from magic_core.data import UNLIMITED, EndOfFrames, Frame, FrameSource
from magic_core.errors import DeadlineExceeded, Unavailable
from magic_core.evaluation import WireBytes
from magic_core.geometry import se3
from magic_core.submap import Submap
from magic_core.wire import names
from magic_core.wire.records import CorrectedPose, PoseSnapshot, SubmapReceipt

log = logging.getLogger(__name__)

Observer = Callable[[str, dict], None]
"""Called with an event name (`frame`, `submap`, `revision`) and its figures."""


class Agent:
    """Runs one frame source against one server until the source ends or `stop` is called."""

    def __init__(
        self,
        source: FrameSource,
        client: MagicClient,
        *,
        session: str,
        name: str,
        config: AgentConfig,
        model: DescriptorModel,
        folder: Path,
        observer: Observer = lambda event, figures: None,
        checkpoint: Callable[[Tally], None] = lambda tally: None,
    ) -> None:
        """`checkpoint` is called on a thread with the figures so far whenever a sub-map is done."""
        self.tally = Tally(name)
        self.corrections: dict[int, CorrectedPose] = {}
        """Newest correction per sub-map index."""
        self._source = source
        self._client = client
        self._session = session
        self._name = name
        self._config = config
        self._model = model
        self._observer = observer
        self._checkpoint = checkpoint
        self._earlier_sizes: tuple[WireBytes, ...] = ()
        self._earlier_wall_s = 0.0
        self._spool = Spool(folder / "spool")
        self._frame_report = FrameReport(folder)
        self._stopping = asyncio.Event()
        self._frames: asyncio.Queue[Frame | None] = asyncio.Queue(config.queue_frames)
        self._pace = (
            Pace(config.rate_hz, queue_frames=config.queue_frames) if config.rate_hz else None
        )
        self._slam_thread = ThreadPoolExecutor(1, f"slam-{name}")
        self._io_threads = ThreadPoolExecutor(2, f"io-{name}")
        self.world_from_camera: NDArray[np.float64] = se3.identity()
        """Newest camera pose in the corrected world of the agent's component."""

    def stop(self) -> None:
        """Leave early: finish the current sub-map, send what there is, and end."""
        self._stopping.set()

    async def run(self) -> Tally:
        """Run to the end. Raises the server's refusals; a lost connection is waited out."""
        self._started = time.monotonic()
        try:
            await self._run()
        finally:
            self._slam_thread.shutdown(wait=False, cancel_futures=True)
            self._io_threads.shutdown(wait=False, cancel_futures=True)
            self._frame_report.close()
            self.tally.wall_s = self._wall_s()
        return self.tally

    async def _run(self) -> None:
        registration = await self._client.register_agent(
            self._session,
            self._name,
            model_id=self._model.model_id,
            dimension=self._model.dimension,
        )
        restart = await find_restart(
            self._spool,
            self._client,
            registration,
            session=self._session,
            agent=self._name,
            executor=self._io_threads,
        )
        self._take_up(restart)
        slam = await asyncio.get_running_loop().run_in_executor(
            self._slam_thread, self._engine, restart.point
        )
        uplink = Uplink(
            self._client,
            self._spool,
            config=self._config.uplink,
            executor=self._io_threads,
            on_spooled=lambda _, sizes: self.tally.wire_bytes.append(sizes),
            on_receipt=self._on_receipt,
            completed=partial(
                with_described_keyframes,
                describe=self._model.describe,
                count=self._config.places_keyframes,
            ),
        )
        async with asyncio.TaskGroup() as group:
            group.create_task(self._read_frames(restart.next_frame))
            watching = group.create_task(self._watch_corrections())
            sending = group.create_task(uplink.run())
            await self._process_frames(slam, uplink)
            await uplink.close()
            await sending
            await self._finish()
            watching.cancel()

    def _engine(self, point: ResumePoint) -> LocalSlam:
        """The local engine, where an earlier process left it."""
        # A known start places the first anchor of all.
        known = self._config.known_start and point.next_index == 0
        return LocalSlam(
            self._source.camera,
            self._config,
            session=self._session,
            agent=self._name,
            describe=self._model.describe,
            world_from_anchor_prior=self._source[0].world_from_camera if known else None,
            resume=point,
        )

    def _take_up(self, restart: Restart) -> None:
        """Count on from where an earlier process was."""
        if restart.state is None:
            return
        self.tally = Tally.from_json(restart.state.tally)
        self.tally.wire_bytes = list(restart.state.wire_bytes)
        self.tally.acknowledged = restart.point.next_index - len(self._spool.pending())
        self._earlier_sizes = restart.state.wire_bytes
        self._earlier_wall_s = self.tally.wall_s

    def _wall_s(self) -> float:
        return self._earlier_wall_s + time.monotonic() - self._started

    async def _read_frames(self, begin: int) -> None:
        loop = asyncio.get_running_loop()
        if self._pace is not None:  # a live camera does not wait for kernels to be loaded
            describe = self._model.describe
            load = partial(warm_up_slam, self._config, describe=describe)
            await loop.run_in_executor(self._slam_thread, load)
        for number in range(begin, len(self._source)):
            if self._stopping.is_set():
                break
            if self._pace is not None:
                await asyncio.sleep(self._pace.wait_s(number))
                if self._frames.full():
                    self.tally.dropped_frames += 1
                    continue
            read = self._source.__getitem__
            try:
                frame = await loop.run_in_executor(self._io_threads, read, number)
            except EndOfFrames as end:  # a live camera: what it showed so far is finished and sent
                log.warning("%s: %s", self._name, end)
                break
            await self._frames.put(frame)
        await self._frames.put(None)

    async def _process_frames(self, slam: LocalSlam, uplink: Uplink) -> None:
        loop, next_frame = asyncio.get_running_loop(), 0
        while (frame := await self._frames.get()) is not None:
            result = await loop.run_in_executor(self._slam_thread, self._process, slam, frame)
            self._count(result)
            next_frame = frame.index + 1
            await self._hand_over(result.finished, result.opening, uplink, next_frame=next_frame)
        last = await loop.run_in_executor(self._slam_thread, slam.finish)
        await self._hand_over(last, None, uplink, next_frame=next_frame)

    def _process(self, slam: LocalSlam, frame: Frame) -> FrameResult:
        """Take in one frame; from a live camera, with no more mapping than there is time for."""
        if self._pace is None:
            return slam.process(frame)
        self.tally.late_ms.append(round(1e3 * self._pace.late_s(frame.index), 3))
        result = slam.process(frame, mapping_s=self._pace.mapping_s(frame.index))
        self._pace.note_tracking(1e-3 * result.tracking_ms)
        return result

    async def _hand_over(
        self, submap: Submap | None, opening: Opening | None, uplink: Uplink, *, next_frame: int
    ) -> None:
        if submap is None:
            return
        self.tally.add_submap(submap)
        self.tally.wall_s = self._wall_s()
        state = ResumeState(
            session=self._session,
            finished_index=submap.index,
            next_frame=next_frame,
            tally=self.tally.to_json(),
            wire_bytes=self._earlier_sizes,
            opening=opening,
        )
        await uplink.put(Finished(submap, state))
        so_far = Tally.from_json(state.tally)
        loop = asyncio.get_running_loop()
        await loop.run_in_executor(self._io_threads, self._checkpoint, so_far)

    def _count(self, result: FrameResult) -> None:
        self.tally.add_frame(result)
        self._frame_report.add(result)
        correction = self.corrections.get(result.submap_index)
        if correction is not None:
            self.world_from_camera = correction.world_from_anchor @ result.anchor_from_camera
        self._observer(
            "frame",
            {
                "frames": self.tally.frames,
                "of": None if len(self._source) == UNLIMITED else len(self._source),
                "lost": self.tally.lost_frames,
                "dropped": self.tally.dropped_frames,
            },
        )

    def _on_receipt(self, index: int, receipt: SubmapReceipt) -> None:
        self.tally.acknowledged += 1
        self._observer("submap", {"submaps": self.tally.acknowledged, "index": index})

    async def _watch_corrections(self) -> None:
        """Apply every revision of the pose graph; reconnect for as long as the agent runs."""
        while True:
            with contextlib.suppress(Unavailable, DeadlineExceeded):
                watch = self._client.watch_corrected_poses(self._session, agent=self._name)
                async for snapshot in watch:
                    self._apply(snapshot)
            await asyncio.sleep(self._config.uplink.longest_retry_s)

    def _apply(self, snapshot: PoseSnapshot) -> None:
        """Take over a new solution: one pose per sub-map, nothing is rewritten."""
        self.corrections = {
            names.parse_submap(name)[2]: pose for name, pose in snapshot.poses.items()
        }
        self.tally.revisions_seen += 1
        self._observer("revision", {"revision": snapshot.revision})

    async def _finish(self) -> None:
        """Tell the server that no more will come; nothing there waits for it."""
        try:
            await self._client.finish_agent(self._session, self._name)
            self.tally.completed = True
            await asyncio.get_running_loop().run_in_executor(self._io_threads, self._spool.clear)
        except (Unavailable, DeadlineExceeded) as error:
            log.warning("%s: could not say goodbye: %s", self._name, error)
