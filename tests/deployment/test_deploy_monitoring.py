"""Prometheus, its alerts and the Grafana dashboard ask for what a server really exports."""

from __future__ import annotations

import asyncio
import dataclasses
import json
import shutil
import subprocess
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import promql_parser
import pytest
import yaml
from prometheus_client import Counter, Histogram
from prometheus_client.parser import text_string_to_metric_families

from magic_server.config import ServerConfig
from magic_server.metrics import Metrics
from magic_server.probes import MetricsConfig
from magic_server.server import Server
from tests.commands import parse_command

DEPLOY = Path(__file__).resolve().parents[2] / "deploy"
MONITORING = DEPLOY / "monitoring"
OF_THE_SCRAPE = {"instance", "job"}
"""Labels that Prometheus itself puts on; a metric's own label of this name would be renamed."""
SUFFIXES = {"counter": ("_total",), "histogram": ("_bucket", "_sum", "_count")}


def dashboard() -> dict[str, Any]:
    return json.loads((MONITORING / "grafana-dashboard.json").read_text())


def expressions() -> Iterator[tuple[str, str]]:
    """Where it stands, and what is asked of Prometheus; Grafana's variables filled in."""
    for panel in dashboard()["panels"]:
        for target in panel["targets"]:
            filled = target["expr"].replace("$__rate_interval", "1m")
            yield panel["title"], filled.replace("$job", ".*").replace("$instance", ".*")
    for group in yaml.safe_load((MONITORING / "alerts.yaml").read_text())["groups"]:
        for rule in group["rules"]:
            yield rule["alert"], rule["expr"]


def selectors(expression: Any) -> Iterator[tuple[str, set[str]]]:
    """Every metric of a PromQL expression with the labels that it is matched by."""
    if isinstance(expression, promql_parser.VectorSelector):
        yield expression.name, {matcher.name for matcher in expression.matchers.matchers}
        return
    for part in ("expr", "lhs", "rhs", "vector_selector", "vs", "args"):
        inner = getattr(expression, part, None)
        for child in inner if isinstance(inner, (list, tuple)) else [inner] if inner else []:
            yield from selectors(child)


def own_labels() -> dict[str, set[str]]:
    """The labels of each metric that has some, by the name of its samples."""
    found: dict[str, set[str]] = {"magic_queue_depth": {"queue"}}
    for metric in vars(Metrics()).values():
        if isinstance(metric, (Counter, Histogram)):
            kind = "counter" if isinstance(metric, Counter) else "histogram"
            for suffix in SUFFIXES[kind]:
                labels = set(metric._labelnames)
                found[metric._name + suffix] = labels | ({"le"} if suffix == "_bucket" else set())
    return found


async def exported(config: ServerConfig) -> set[str]:
    """The names of all samples that a running server shows or would show once they happen."""
    async with Server(dataclasses.replace(config, metrics=MetricsConfig(port=0))) as server:

        def fetch() -> str:
            url = f"http://{server.metrics_address}/metrics"
            with urllib.request.urlopen(url, timeout=20) as answer:
                return answer.read().decode()

        families = list(text_string_to_metric_families(await asyncio.to_thread(fetch)))
    return {
        family.name + suffix for family in families for suffix in SUFFIXES.get(family.type, ("",))
    }


async def test_every_metric_and_label_that_is_asked_for_is_exported(
    server_config: ServerConfig,
) -> None:
    names, labels = await exported(server_config), own_labels()
    asked: set[str] = set()
    for where, text in expressions():
        found = list(selectors(promql_parser.parse(text)))
        assert found, f"{where}: asks for nothing"
        for name, matched in found:
            assert name in names | {"up"}, f"{where}: no metric {name}"
            assert matched <= labels.get(name, set()) | OF_THE_SCRAPE, f"{where}: {matched}"
            asked.add(name.removesuffix("_bucket").removesuffix("_count"))
    derived = ("_sum", "_bucket", "_count", "_created")
    own = {name for name in names if name.startswith("magic_") and not name.endswith(derived)}
    forgotten = own - asked
    assert not forgotten, "neither the dashboard nor an alert shows these"


def test_no_label_is_one_that_prometheus_would_rename() -> None:
    for name, labels in own_labels().items():
        assert not labels & OF_THE_SCRAPE, name


def test_groupings_and_legends_name_labels_that_are_left() -> None:
    labels = set().union(*own_labels().values()) | OF_THE_SCRAPE
    for panel in dashboard()["panels"]:
        for target in panel["targets"]:
            expression = promql_parser.parse(target["expr"].replace("$__rate_interval", "1m"))
            shown = {part.split("}}")[0] for part in target["legendFormat"].split("{{")[1:]}
            assert shown <= labels, panel["title"]
            text = expression.prettify() if hasattr(expression, "prettify") else target["expr"]
            if " by (" in text:
                kept = text.split(" by (")[1].split(")")[0].replace(" ", "").split(",")
                assert shown <= set(kept), panel["title"]


def test_panels_do_not_overlap_and_have_identities() -> None:
    panels = dashboard()["panels"]
    assert len({panel["id"] for panel in panels}) == len(panels)
    taken: set[tuple[int, int]] = set()
    for panel in panels:
        place = panel["gridPos"]
        cells = {
            (x, y)
            for x in range(place["x"], place["x"] + place["w"])
            for y in range(place["y"], place["y"] + place["h"])
        }
        assert place["x"] + place["w"] <= 24, panel["title"]
        assert not cells & taken, panel["title"]
        taken |= cells


def test_prometheus_scrapes_the_port_that_the_compose_file_opens() -> None:
    compose = yaml.safe_load((DEPLOY / "compose.yaml").read_text())
    server = parse_command(compose["services"]["server"]["command"])
    scraped = yaml.safe_load((MONITORING / "prometheus.yaml").read_text())["scrape_configs"]
    assert [job["job_name"] for job in scraped] == ["magic-slam"]
    assert scraped[0]["static_configs"][0]["targets"] == [f"server:{server.metrics.port}"]
    mounted = {volume.split(":")[0] for name in ("prometheus", "grafana")
               for volume in compose["services"][name]["volumes"]}  # fmt: skip
    provider = yaml.safe_load((MONITORING / "grafana-provider.yaml").read_text())
    (folder,) = (entry["options"]["path"] for entry in provider["providers"])
    assert any(folder in volume for volume in compose["services"]["grafana"]["volumes"])
    assert len(mounted) == 5


@pytest.mark.parametrize(
    "command", [("config", "--syntax-only", "prometheus.yaml"), ("rules", "alerts.yaml")]
)
def test_promtool_accepts_it(command: tuple[str, ...]) -> None:
    if shutil.which("promtool") is None:
        pytest.skip("promtool (Debian: prometheus) is not here; PromQL is parsed all the same")
    subprocess.run(["promtool", "check", *command], cwd=MONITORING, check=True, capture_output=True)
