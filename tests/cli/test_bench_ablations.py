"""The ablation benchmark's tables and options."""

from __future__ import annotations

import json

import pytest
from rich.console import Console

from magic_cli.benchmarks.ablations import FULL, main, tables, variants
from magic_core.errors import ConfigError, MagicError


def metrics(ate_cm: float, psnr: float, *, lpips: float | None = 0.1) -> dict:
    """What `magic run --json` prints, as far as the tables read it."""
    kinds = ("train", "novel", "train_coarse", "novel_coarse")
    return {
        "ate_rmse_m": {"agent_0": ate_cm / 100, "agent_1": 2 * ate_cm / 100, "joint": None},
        "ate_tracked_rmse_m": {"agent_0": 0.05, "agent_1": 0.07},
        "psnr_db": dict.fromkeys(kinds, psnr),
        "ssim": dict.fromkeys(kinds, 0.9),
        "lpips": dict.fromkeys(kinds, lpips),
        "depth_l1_m": dict.fromkeys(kinds, 0.012),
        "loops": {"detected": 5, "accepted": 3},
        "components": 1,
        "wire_bytes_per_submap": {"compact": 1_500_000, "lossless": 3_000_000},
        "peak_rss_bytes": 4e8,
        "tracking_ms": {"median": 90.0},
        "merge_s": 12.0,
    }


def printed(results: dict) -> str:
    console = Console(width=250, no_color=True)
    with console.capture() as capture:
        for rows in tables(results):
            console.print(rows)
    return capture.get()


def test_tables_show_mean_and_band_over_seeds():
    text = printed({
        FULL: {0: metrics(1.0, 24.0), 1: metrics(3.0, 26.0)},
        "without loop closure": {0: metrics(4.0, 20.0, lpips=None)},
    })  # fmt: skip
    full = next(line for line in text.splitlines() if FULL in line)
    assert "2.00 (1.00 to 3.00)" in full  # agent_0
    assert "4.00 (2.00 to 6.00)" in full  # agent_1
    assert "3.00 (1.50 to 4.50)" in full  # their average
    assert "25.00 (24.00 to 26.00)" in text
    alone = next(line for line in text.splitlines() if "without loop closure" in line)
    assert "4.00" in alone
    assert "to" not in alone.replace("without", "")  # one seed has no band
    for title in ("Tracking", "Loops", "Rendering", "Map merging", "Size and time"):
        assert title in text


def test_every_table_of_the_paper_has_its_variant():
    names = [variant.name for variant in variants(("models/dinov2.onnx",))]
    assert names[0] == FULL
    assert set(names[1:]) == {
        "without loop closure", "without pose initialisation", "loops by FPFH on anchor clouds",
        "loops by Gaussian means", "all Gaussians sent", "encoder dinov2",
    }  # fmt: skip


def test_wrong_seeds_and_variants_are_named():
    with pytest.raises(ConfigError, match="seeds"):
        main(["data", "--seeds", "0,x"])
    with pytest.raises(ConfigError, match="without loop closure"):
        main(["data", "--only", "nothing"])


def test_a_dataset_that_is_not_there_ends_with_the_runs_own_words(tmp_path):
    with pytest.raises(MagicError, match="full system did not run"):
        main([str(tmp_path / "nowhere"), "--seeds", "0", "--only", "all Gaussians sent"])


def test_kept_runs_are_not_run_again(tmp_path, capsys):
    for variant in (FULL, "without loop closure"):
        folder = tmp_path / variant.replace(" ", "_") / "seed_0"
        folder.mkdir(parents=True)
        (folder / "metrics.json").write_text(json.dumps(metrics(1.0, 24.0)))
    options = ["--seeds", "0", "--only", "without loop closure", "--keep", str(tmp_path), "--json"]
    assert main(["data", *options]) == 0
    said = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert set(said["variants"]) == {FULL, "without loop closure"}
    assert said["failed"] == {}
