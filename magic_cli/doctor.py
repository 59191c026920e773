"""`magic doctor`: is this machine ready? Each check ends ok, warn or fail, with the remedy.

Ends with 1 if a check failed; warnings do not count.

Examples:
  magic doctor
  magic doctor --warm        # compile all kernels now, so that the first run starts at once
  magic doctor --port 50061 --folder /srv/magic --json
  magic doctor --blobs s3://robots/magic --s3-endpoint https://s3.example:9000
"""

from __future__ import annotations

import dataclasses
import time
from dataclasses import dataclass
from pathlib import Path

from magic_cli.bucket_check import bucket
from magic_cli.machine import Check, all_checks
from magic_cli.options import parse
from magic_cli.output import console, print_json, table
from magic_server.store_config import StoreConfig


@dataclass(frozen=True, slots=True)
class DoctorConfig:
    """Options of `magic doctor`."""

    warm: bool = False
    """Compile all render and tracking kernels now, so that the first run starts at once."""
    port: int = 50051
    """Port on which a server would listen."""
    places_model: str | None = None
    """Image encoder to try instead of the default, as --places-model of `magic run`."""
    folder: Path = Path()
    """Where results would be written: its disk is checked."""
    blobs: str = ""
    """Bucket to try, as --store.blobs of `magic serve`."""
    s3_endpoint: str = ""
    """URL of its S3 server; empty for AWS."""
    s3_region: str = ""
    """Its region; empty for that of the environment."""
    json: bool = False
    """Print one JSON object as the last line."""


def main(arguments: list[str]) -> int:
    """Run every check; 1 if one failed."""
    config = parse(DoctorConfig, arguments, prog="magic doctor", description=__doc__ or "")
    checks = []
    with console.status("looking") as status:
        for name, check in all_checks(
            port=config.port, folder=config.folder, places_model=config.places_model
        ):
            status.update(f"looking at {name}")
            checks.append(check())
    if config.blobs:
        store = StoreConfig(
            blobs=config.blobs, s3_endpoint=config.s3_endpoint, s3_region=config.s3_region
        )
        checks.append(bucket(store))
    if config.warm:
        checks.append(_warm_up())
    colours = {"ok": "green", "warn": "yellow", "fail": "red"}
    rows = [[c.name, f"[{colours[c.status]}]{c.status}[/]", c.detail, c.remedy] for c in checks]
    console.print(table("magic doctor", ["check", "status", "found", "remedy"], rows, words=True))
    failed = any(check.status == "fail" for check in checks)
    if config.json:
        print_json({"ok": not failed, "checks": [dataclasses.asdict(check) for check in checks]})
    return 1 if failed else 0


def _warm_up() -> Check:
    from magic_agent.warmup import warm_up_slam

    start = time.perf_counter()
    with console.status("compiling or loading kernels") as status:
        report = warm_up_slam(progress=status.update)
    seconds = time.perf_counter() - start
    where = report.cache_folder or "nowhere: no folder can be written"
    return Check("kernels", "ok", f"compiled or loaded in {seconds:.0f} s, kept in {where}")
