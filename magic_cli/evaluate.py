"""`magic eval RUN`: measure a finished run again and rewrite its report.

Also measures a run that was cut short. Ground truth and images are read from the dataset again.

Examples:
  magic eval runs/office
  magic eval runs/office --dataset /mnt/disk/office --no-report --json
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from magic_cli.options import parse
from magic_cli.output import print_json
from magic_core.errors import DataError


@dataclass(frozen=True, slots=True)
class EvalConfig:
    """Options of `magic eval`."""

    run: Positional[Path]
    """Run folder."""
    dataset: str | None = None
    """Where the data lies now; default: where the run found it."""
    report: bool = True
    """Rewrite report.html too."""
    lpips_weights: Path | None = None
    """AlexNet weights for LPIPS (safetensors); default: MAGIC_LPIPS_WEIGHTS or the usual places."""
    views: int = 48
    """Most views rendered of each kind, spread evenly over agents and time."""
    json: bool = False
    """Print one JSON object as the last line."""


def main(arguments: list[str]) -> int:
    """Evaluate, rewrite metrics.json, print the table."""
    config = parse(EvalConfig, arguments, prog="magic eval", description=__doc__ or "")
    from magic_cli.evaluation import measure_again, write_report
    from magic_cli.run import RunConfig
    from magic_cli.summary import print_summary
    from magic_core.config import load_yaml
    from magic_core.data import open_dataset
    from magic_core.evaluation import RunFolder

    folder = RunFolder(config.run)
    if not folder.config_path.is_file():
        raise DataError(f"{config.run}: no config.yaml in it; expected the folder of `magic run`")
    run = load_yaml(RunConfig, folder.config_path)
    sources = open_dataset(
        config.dataset or run.dataset, scale=run.scale, max_frames=run.frames, stride=run.stride
    )
    metrics = measure_again(
        folder, sources, lpips_weights=config.lpips_weights, views_per_kind=config.views
    )
    if config.report:
        write_report(folder, sources)
    print_summary(metrics, folder)
    if config.json:
        print_json(metrics)
    return 0
