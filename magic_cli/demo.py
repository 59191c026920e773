"""`magic demo`: three agents map a generated flat, from unknown starts, end to end.

The flat is rendered by the project itself; nothing is downloaded. Everything that `magic run` can
be told, `magic demo` can be told too.

Examples:
  magic demo
  magic demo --frames 60 --out runs/quick
  magic demo --flat.agents 2 --data runs/two --json
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from rich.progress import Progress
from tyro.conf import Suppress

from magic_cli.options import parse
from magic_cli.output import console, print_json
from magic_cli.run import RunConfig, default_out, run
from magic_core.config import field_names
from magic_core.data.synthetic import SyntheticConfig
from magic_server.globalmap import MergeConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class DemoConfig(RunConfig):
    """Options of `magic demo`."""

    dataset: Suppress[str] = ""
    data: Path = Path("runs/demo-data")
    """Where the generated sequences lie; they are made once."""
    only_data: bool = False
    """Generate the sequences and stop."""
    merge: MergeConfig = field(default_factory=lambda: MergeConfig(passes=8))
    """Server: how the global map is made; the flat needs fewer passes than real images."""
    flat: SyntheticConfig = field(default_factory=SyntheticConfig)
    """The flat and the walks through it."""


def main(arguments: list[str]) -> int:
    """Generate the flat where it is not there yet, then run on it."""
    config = parse(DemoConfig, arguments, prog="magic demo", description=__doc__ or "")
    config.validate()
    generate(config)
    if config.only_data:
        return 0
    settings = {name: getattr(config, name) for name in field_names(RunConfig)}
    settings |= {"dataset": str(config.data), "out": config.out or default_out("demo")}
    metrics = run(RunConfig(**settings))
    if config.json:
        print_json(metrics)
    return 0


def generate(config: DemoConfig) -> None:
    """Render the walks of all agents to disk, in the Replica layout."""
    if config.data.exists():
        return
    from magic_core.data import write_replica
    from magic_core.data.synthetic import synthetic_flat

    with Progress(console=console, transient=True) as bar:
        task = bar.add_task("rendering the flat", total=None)
        write_replica(
            synthetic_flat(config.flat),
            config.data,
            progress=lambda done, total: bar.update(task, completed=done, total=total),
        )
    console.print(f"Generated {config.flat.agents} walks through a flat: {config.data}")
