"""The table at the end of a run."""

from __future__ import annotations

from magic_cli.output import console, table
from magic_core.evaluation import RunFolder


def print_summary(metrics: dict, folder: RunFolder) -> None:
    """Print what a person wants to know first, and where the rest is."""
    console.print(_accuracy(metrics))
    console.print(_map_quality(metrics))
    console.print(table("Run", ["", "value"], _facts(metrics)))
    if folder.report_path.is_file():
        _say(f"Report: {folder.report_path}")
    _say(f"Map:    {folder.map_path}  (opens in SuperSplat and other 3DGS viewers)")
    _say(f"Look:   magic view {folder.path}")


def _say(line: str) -> None:
    console.print(line, highlight=False, soft_wrap=True, markup=False)


def _accuracy(metrics: dict):
    ate = metrics.get("ate_rmse_m") or {}
    tracked = metrics.get("ate_tracked_rmse_m") or {}
    rows = [
        [name, _centimetres(tracked.get(name)), _centimetres(value)] for name, value in ate.items()
    ]
    return table("Trajectory error, ATE RMSE", ["agent", "odometry alone", "corrected"], rows)


_QUALITY = (
    ("PSNR", "psnr_db", 1, " dB"),
    ("SSIM", "ssim", 1, ""),
    ("MS-SSIM", "ms_ssim", 1, ""),
    ("LPIPS", "lpips", 1, ""),
    ("depth error", "depth_l1_m", 100, " cm"),
)


def _map_quality(metrics: dict):
    """Keyframes and new views, before and after the fine stage of merging."""
    rows = []
    for label, name, factor, unit in _QUALITY:
        values = metrics.get(name) or {}
        digits = 3 if not unit else 2
        rows.append([label] + [
            "-" if values.get(key) is None else f"{factor * values[key]:.{digits}f}{unit}"
            for key in ("train_coarse", "train", "novel_coarse", "novel")
        ])  # fmt: skip
    columns = ["", "keyframes, appended", "refined", "new views, appended", "refined"]
    return table("Merged map", columns, rows)


def _facts(metrics: dict) -> list[list[str]]:
    loops, wire = metrics["loops"], metrics["wire_bytes_per_submap"]
    rejected = sum(loops["rejected"].values())
    components = metrics.get("components")
    return [
        ["components", str(components if isinstance(components, int) else len(components or ()))],
        ["frames (lost)", f"{metrics['frames']} ({metrics['lost_frames']})"],
        ["sub-maps", str(metrics["submaps"])],
        ["loops accepted / rejected", f"{loops['accepted']} / {rejected}"],
        ["tracking / mapping per frame", f"{metrics['tracking_ms']['median']} / "
                                         f"{metrics['mapping_ms']['median']} ms (median)"],
        *_left_out(metrics),
        ["all agents together", _number(metrics["fps"], 1, " frames/s")],
        ["sub-map on the wire", f"{_megabytes(wire['compact'])} "
                                f"(lossless {_megabytes(wire['lossless'])})"],
        ["Gaussians", "-" if metrics["gaussians"] is None else f"{metrics['gaussians']:,}"],
        ["merge", _number(metrics["merge_s"], 1, " s")],
        ["whole run", _number(metrics["wall_s"], 1, " s")],
    ]  # fmt: skip


def _left_out(metrics: dict) -> list[list[str]]:
    """What live agents left out to keep up with their cameras; nothing to say of other runs."""
    left_out, late_ms = metrics.get("left_out"), metrics.get("late_ms") or {}
    if not left_out or late_ms.get("median") is None:
        return []
    return [
        ["left out to keep up", f"{left_out['frames']} frames, {left_out['keyframes']} keyframes, "
                                f"{left_out['mapping_steps']} of {left_out['of_mapping_steps']} "
                                "mapping steps"],
        ["behind the camera", f"{late_ms['median']} ms (median), {late_ms['p95']} ms (95 %)"],
    ]  # fmt: skip


def _number(value: float | None, factor: float, unit: str) -> str:
    return "-" if value is None else f"{value * factor:.1f}{unit}"


def _centimetres(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.2f} cm"


def _megabytes(count: float | None) -> str:
    return "-" if count is None else f"{count / 1e6:.2f} MB"
