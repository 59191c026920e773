"""`magic agent DATASET --server HOST:PORT`: run one agent against a server.

Examples:
  magic agent ~/recordings/kitchen --server 192.168.1.20:50051 --session kitchen --name robot_1
  magic agent DATASET --name agent_0 --rate-hz 30      # play it in real time
  MAGIC_TOKEN=... magic agent DATASET --server map.example:50051 --credentials.ca ca.pem
"""

from __future__ import annotations

import asyncio
import json
import signal
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from magic_agent.config import AgentConfig
from magic_cli.options import parse
from magic_cli.output import console, print_json
from magic_core import logs, tracing
from magic_core.errors import DataError
from magic_core.logs import LogConfig
from magic_core.tracing import TracingConfig
from magic_core.wire import ClientCredentials


@dataclass(frozen=True, slots=True, kw_only=True)
class AgentCommand(AgentConfig):
    """Options of `magic agent`."""

    dataset: Positional[str]
    """Folder of a dataset, or synthetic://flat?agents=3&frames=120."""
    name: str = "agent_0"
    """Which recording of the dataset, and the agent's name on the server. Where the dataset holds
    a single recording, any name will do."""
    server: str = "127.0.0.1:50051"
    """Address of the server; of several that share a database, with commas: a:50051,b:50051. The
    agent follows its session from one to the other."""
    session: str = "default"
    """Agents of one session map one place together."""
    out: Path = Path("runs/agents")
    """Folder for agents/{name} (spool, report) and trajectories/."""
    scale: float = 1.0
    """Process images at this fraction of their size."""
    frames: int | None = None
    """Use only so many frames."""
    stride: int = 1
    """Use every n-th frame."""
    credentials: ClientCredentials = field(default_factory=ClientCredentials)
    """Encryption and token; the token alone can also come from the variable MAGIC_TOKEN."""
    logs: LogConfig = field(default_factory=LogConfig)
    """How log lines look."""
    tracing: TracingConfig = field(default_factory=TracingConfig)
    """Where traces go."""
    progress: Literal["bar", "json", "none"] = "bar"
    """`json` prints one line per event on stdout, for programs."""
    json: bool = False
    """Print the report as one JSON object on the last line."""


def main(arguments: list[str]) -> int:
    """Run one agent; 0 when everything it mapped was acknowledged."""
    command = parse(AgentCommand, arguments, prog="magic agent", description=__doc__ or "")
    logs.configure(command.logs)
    logs.bind(session=command.session, agent=command.name)
    tracing.configure(command.tracing, service=f"magic-agent {command.name}")
    try:
        report = asyncio.run(run_agent(command))
    finally:
        tracing.shut_down()
    if command.json:
        print_json(report)
    return 0 if report["completed"] else 1


async def run_agent(command: AgentCommand) -> dict:
    """Run the agent of a command, write its report and trajectory, return the counters."""
    from magic_agent.agent import Agent
    from magic_agent.client import ClientConfig, MagicClient
    from magic_agent.places import load_descriptor_model
    from magic_agent.tally import Tally
    from magic_core.evaluation import RunFolder

    source = _source(command)
    folder = RunFolder(command.out)
    model = load_descriptor_model(command.places_model)

    def keep(tally: Tally) -> None:
        """Write the figures so far: an agent that is killed is in the report as far as it came."""
        report = tally.report(camera=source.camera, dataset=command.dataset, scale=command.scale)
        folder.write_agent_report(report)
        folder.write_trajectory(command.name, "tracked", tally.trajectory())

    async with MagicClient(command.server, ClientConfig(credentials=command.credentials)) as client:
        agent = Agent(
            source,
            client,
            session=command.session,
            name=command.name,
            config=command,
            model=model,
            folder=folder.agents_folder / command.name,
            observer=_observer(command.progress),
            checkpoint=keep,
        )
        loop = asyncio.get_running_loop()
        for signal_number in (signal.SIGINT, signal.SIGTERM):
            loop.add_signal_handler(signal_number, agent.stop)
        try:
            tally = await agent.run()
        finally:
            keep(agent.tally)
    return {
        "agent": command.name,
        "completed": tally.completed,
        "frames": tally.frames,
        "lost_frames": tally.lost_frames,
        "dropped_frames": tally.dropped_frames,
        "skipped_keyframes": tally.skipped_keyframes,
        "cut_mapping_steps": tally.cut_mapping_steps,
        "submaps": tally.acknowledged,
        "revisions_seen": tally.revisions_seen,
        "wall_s": round(tally.wall_s, 3),
    }


def _source(command: AgentCommand):
    from magic_core.data import open_dataset

    sources = open_dataset(
        command.dataset, scale=command.scale, max_frames=command.frames, stride=command.stride
    )
    if len(sources) == 1:
        return sources[0]
    for source in sources:
        if source.name == command.name:
            return source
    names = ", ".join(source.name for source in sources)
    raise DataError(f"{command.dataset}: no recording {command.name!r}; it has {names}")


def status_line(seen: dict) -> str:
    """How far an agent is, from the figures of its events; `live` where no length is known."""
    of = seen.get("of")
    return (
        f"frame {seen.get('frames', 0)}{f'/{of}' if of else ', live'}, "
        f"{seen.get('dropped', 0)} dropped, {seen.get('lost', 0)} lost, "
        f"{seen.get('submaps', 0)} sub-maps acknowledged, "
        f"pose graph revision {seen.get('revision', 0)}"
    )


def _observer(progress: str):
    """What becomes of an agent's events: a line of JSON each, a status line, or nothing."""
    if progress == "json":

        def print_line(event: str, figures: dict) -> None:
            sys.stdout.write(json.dumps(figures) + "\n")
            sys.stdout.flush()

        return print_line
    if progress == "bar" and console.is_terminal:
        status = console.status("starting")
        status.start()
        seen: dict = {}

        def show(event: str, figures: dict) -> None:
            seen.update(figures)
            status.update(status_line(seen))

        return show
    return lambda event, figures: None
