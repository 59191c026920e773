"""The table at the end of a run."""

from __future__ import annotations

from magic_cli.output import console, table
from magic_core.evaluation import RunFolder


def print_summary(metrics: dict, folder: RunFolder) -> None:
    """Print what a person wants to know first, and where the rest is."""
    console.print(_accuracy(metrics))
    console.print(table("Run", ["", "value"], _facts(metrics)))
    console.print(f"Report: {folder.report_path}", highlight=False, soft_wrap=True)
    console.print(f"Map:    {folder.map_path}  (opens in SuperSplat and other 3DGS viewers)",
                  highlight=False, soft_wrap=True)  # fmt: skip


def _accuracy(metrics: dict):
    ate = metrics.get("ate_rmse_m") or {}
    tracked = metrics.get("ate_tracked_rmse_m") or {}
    rows = [
        [name, _centimetres(tracked.get(name)), _centimetres(value)] for name, value in ate.items()
    ]
    return table("Trajectory error, ATE RMSE", ["agent", "odometry alone", "corrected"], rows)


def _facts(metrics: dict) -> list[list[str]]:
    loops, wire = metrics["loops"], metrics["wire_bytes_per_submap"]
    rejected = sum(loops["rejected"].values())
    psnr, depth = metrics.get("psnr_db") or {}, metrics.get("depth_l1_m") or {}
    components = metrics.get("components")
    return [
        ["components", str(components if isinstance(components, int) else len(components or ()))],
        ["frames (lost)", f"{metrics['frames']} ({metrics['lost_frames']})"],
        ["sub-maps", str(metrics["submaps"])],
        ["loops accepted / rejected", f"{loops['accepted']} / {rejected}"],
        ["PSNR keyframes / new views", f"{_number(psnr.get('train'), 1, '')} / "
                                       f"{_number(psnr.get('novel'), 1, ' dB')}"],
        ["depth error keyframes / new views", f"{_number(depth.get('train'), 100, '')} / "
                                              f"{_number(depth.get('novel'), 100, ' cm')}"],
        ["tracking / mapping per frame", f"{metrics['tracking_ms']['median']} / "
                                         f"{metrics['mapping_ms']['median']} ms (median)"],
        ["all agents together", _number(metrics["fps"], 1, " frames/s")],
        ["sub-map on the wire", f"{_megabytes(wire['compact'])} "
                                f"(lossless {_megabytes(wire['lossless'])})"],
        ["Gaussians", "-" if metrics["gaussians"] is None else f"{metrics['gaussians']:,}"],
        ["merge", _number(metrics["merge_s"], 1, " s")],
        ["whole run", _number(metrics["wall_s"], 1, " s")],
    ]  # fmt: skip


def _number(value: float | None, factor: float, unit: str) -> str:
    return "-" if value is None else f"{value * factor:.1f}{unit}"


def _centimetres(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.2f} cm"


def _megabytes(count: float | None) -> str:
    return "-" if count is None else f"{count / 1e6:.2f} MB"
