"""One run on this machine: a server, one process per agent, and the session that they share.

Whatever happens to single agents, the run goes on: what arrived is merged. A Ctrl-C ends the stage
it comes in: mapping (the agents finish their sub-maps, send them, and the run merges), then merging
(the sub-maps are kept as they were appended). A further one ends at once.
"""

from __future__ import annotations

import asyncio
import contextlib
import shutil
import signal
import time
from dataclasses import dataclass, field

from magic_agent.client import ClientConfig, MagicClient
from magic_cli import processes
from magic_cli.agent import AgentCommand
from magic_cli.collect import collect, collect_map, write_ground_truth
from magic_cli.processes import Child
from magic_cli.progress import RunProgress
from magic_cli.run import RunConfig, agent_settings, server_settings
from magic_core.config import save_yaml
from magic_core.data import FrameSource
from magic_core.errors import DataError
from magic_core.evaluation import RunFolder

SESSION = "run"
SERVER_START_TIMEOUT_S = 120.0
RPC_TIMEOUT_S = 120.0
"""Our own server on this machine may be slow when the machine is busy, but it is not away."""
VIEWER_START_TIMEOUT_S = 120.0
VIEWER_STOP_TIMEOUT_S = 60.0


@dataclass(slots=True)
class Outcome:
    """How a run went, apart from its accuracy."""

    agents: dict[str, str] = field(default_factory=dict)
    """agent -> `completed`, or how it ended instead."""
    mapping_s: float = 0.0
    """From the first agent's start to the last one's end."""
    merge_s: float = 0.0
    gaussians: int = 0


class LocalRun:
    """Starts and follows the processes of one run, then collects what the server knows."""

    def __init__(self, config: RunConfig, sources: list[FrameSource], folder: RunFolder) -> None:
        self._config = config
        self._sources = sources
        self._folder = folder
        self._agents: list[Child] = []
        self._viewer: Child | None = None
        self._interrupted = False
        self._merging: asyncio.Future | None = None
        self._outcome = Outcome()

    async def run(self) -> Outcome:
        """Run to the end. Raises DataError when not a single sub-map arrived."""
        with RunProgress(self._sources) as progress, self._interruptible(progress):
            server = await self._start_server()
            try:
                target = (await processes.wait_ready(server, timeout_s=SERVER_START_TIMEOUT_S))[
                    "target"
                ]
                await self._start_viewer(target, progress)
                await self._run_agents(target, progress)
                await self._finish(target, progress)
            finally:
                for child in self._agents:
                    await processes.stop(child, timeout_s=5.0)
                if self._viewer is not None:  # before the server: it fetches what it lacks
                    await processes.stop(self._viewer, timeout_s=VIEWER_STOP_TIMEOUT_S)
                await processes.stop(server)
        return self._outcome

    async def _start_server(self) -> Child:
        path = self._folder.server_folder / "config.yaml"
        save_yaml(server_settings(self._config, self._folder.server_folder), path)
        return await processes.start(
            "server",
            ["serve", "--config", str(path), "--progress", "json"],
            log=self._folder.server_folder / "log.txt",
            threads=1,
        )

    async def _start_viewer(self, target: str, progress: RunProgress) -> None:
        """The page and the recording, where asked for, in a process of low priority."""
        config = self._config
        if not config.viewer and config.rerun is None:
            return
        arguments = ["view", target, "--session", SESSION, "--progress", "json"]
        page = ["--port", str(config.viewer_port), "--max-splats", str(config.viewer_splats)]
        arguments += page if config.viewer else ["--no-page"]
        arguments += ["--rerun", str(config.rerun)] if config.rerun is not None else []
        log = self._folder.server_folder / "view-log.txt"
        self._viewer = await processes.start("viewer", arguments, log=log, threads=1)
        processes.give_way(self._viewer.process.pid)
        ready = await processes.wait_ready(self._viewer, timeout_s=VIEWER_START_TIMEOUT_S)
        if ready["page"] is not None:
            progress.say(f"Open {ready['page']} in a browser to watch.")

    async def _run_agents(self, target: str, progress: RunProgress) -> None:
        start = time.perf_counter()
        threads = self._config.threads or processes.fair_threads(len(self._sources))
        async with asyncio.TaskGroup() as group:
            for source in self._sources:
                child = await self._start_agent(source.name, target, threads)
                self._agents.append(child)
                group.create_task(self._follow(child, progress))
        self._outcome.mapping_s = time.perf_counter() - start

    async def _start_agent(self, name: str, target: str, threads: int) -> Child:
        folder = self._folder.agents_folder / name
        command = AgentCommand(
            dataset=self._config.dataset,
            name=name,
            server=target,
            session=SESSION,
            out=self._folder.path,
            scale=self._config.scale,
            frames=self._config.frames,
            stride=self._config.stride,
            progress="json",
            **agent_settings(self._config),
        )
        save_yaml(command, folder / "config.yaml")
        arguments = ["agent", "--config", str(folder / "config.yaml")]
        return await processes.start(name, arguments, log=folder / "log.txt", threads=threads)

    async def _follow(self, child: Child, progress: RunProgress) -> None:
        code = await processes.follow(child, progress.agent)
        state = "completed" if code == 0 else f"ended with exit code {code}"
        self._outcome.agents[child.name] = state
        progress.agent_ended(child.name, state)
        if code != 0:
            progress.say(f"{child.name} {state}; the run goes on without it. Its log ends:")
            progress.say(child.tail())

    async def _finish(self, target: str, progress: RunProgress) -> None:
        write_ground_truth(self._folder, self._sources)
        async with MagicClient(target, ClientConfig(rpc_timeout_s=RPC_TIMEOUT_S)) as client:
            if not await client.list_sessions() or not await client.list_submaps(SESSION):
                logs = self._folder.agents_folder
                raise DataError(f"no sub-map reached the server; see the agents' logs in {logs}")
            await collect(client, SESSION, self._folder)  # what is cheap: merging may be cut short
            start = time.perf_counter()
            self._outcome.gaussians = await self._merge(client, progress)
            self._outcome.merge_s = time.perf_counter() - start
            await collect(client, SESSION, self._folder)

    async def _merge(self, client: MagicClient, progress: RunProgress) -> int:
        """Fetch the appended and the refined map; a Ctrl-C meanwhile keeps the appended one."""
        limits = {"timeout_s": self._config.merge_timeout_s, "progress": progress.merge}
        appended = await collect_map(client, SESSION, self._folder, coarse=True, **limits)
        self._merging = asyncio.ensure_future(collect_map(client, SESSION, self._folder, **limits))
        try:
            return (await self._merging).gaussian_count
        except asyncio.CancelledError:
            if asyncio.current_task().cancelling():  # type: ignore[union-attr]
                raise
            progress.say("Merging was interrupted: the map holds the sub-maps as they were sent.")
            await asyncio.to_thread(shutil.copyfile, self._folder.coarse_map_path,
                                    self._folder.map_path)  # fmt: skip
            return appended.gaussian_count

    @contextlib.contextmanager
    def _interruptible(self, progress: RunProgress):
        loop = asyncio.get_running_loop()
        task = asyncio.current_task()
        assert task is not None

        def interrupt() -> None:
            running = [child for child in self._agents if child.exit_code is None]
            if running and not self._interrupted:
                progress.say("Interrupted: agents finish and send their sub-maps, then the map is "
                             "merged. Ctrl-C again ends at once.")  # fmt: skip
                for child in running:
                    processes.ask_to_stop(child)
            elif self._merging is not None and not self._merging.done():
                self._merging.cancel()
            else:
                task.cancel()
            self._interrupted = True

        for number in (signal.SIGINT, signal.SIGTERM):
            loop.add_signal_handler(number, interrupt)
        try:
            yield
        finally:
            for number in (signal.SIGINT, signal.SIGTERM):
                loop.remove_signal_handler(number)
