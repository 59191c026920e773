"""What helm makes of the chart: the kustomizations' objects, and settings that `magic` takes."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import kubernetes_validate
import pytest
import yaml
from distributed.cli.dask_scheduler import main as dask_scheduler

from magic_cli.serve import ServeCommand
from magic_cli.worker import WorkerCommand
from magic_core.config import load_yaml
from magic_server.jobs.config import parse_resources
from magic_server.server import LIVENESS, READINESS
from tests.commands import parse_command
from tests.helm import (
    CHART,
    CLUSTER,
    EVERYTHING,
    ONE,
    VARIANTS,
    Values,
    helm,
    merged,
    pod_of,
    read,
    rendered,
)

DEPLOY = CHART.parents[1]


def config_of(objects: dict[tuple[str, str], Any], folder: Path) -> ServeCommand:
    path = folder / "server.yaml"
    path.write_text(objects["ConfigMap", "magic-config"]["data"]["server.yaml"])
    return load_yaml(ServeCommand, path)


def comparable(item: Any) -> Any:
    """An object without what only one of both ways of writing it has."""
    if isinstance(item, dict):
        kept = {
            key: comparable(value) for key, value in item.items()
            if key not in ("app.kubernetes.io/instance", "checksum/config")
        }  # fmt: skip
        if isinstance(kept.get("image"), str):
            kept["image"] = kept["image"].rpartition(":")[0] or kept["image"]
        if {"kind", "metadata"} <= kept.keys():
            kept["metadata"] = {"name": kept["metadata"]["name"]}
        return kept
    return [comparable(value) for value in item] if isinstance(item, list) else item


# The chart and the kustomizations


@pytest.mark.parametrize("values", VARIANTS.values(), ids=VARIANTS)
def test_helm_finds_nothing_wrong(values: Values) -> None:
    found = helm("lint", "--strict", CHART, values=yaml.safe_dump(values))
    assert found.returncode == 0, found.stdout + found.stderr


@pytest.mark.parametrize(
    ("values", "folder"), [(ONE, "kubernetes"), (CLUSTER, "kubernetes-cluster")],
    ids=["one-server", "cluster"],
)  # fmt: skip
def test_an_example_makes_the_objects_of_its_kustomization(values: Values, folder: str) -> None:
    listed = read(DEPLOY / folder / "kustomization.yaml")
    wanted = {
        (item["kind"], item["metadata"]["name"]): comparable(item)
        for name in listed["resources"]
        for item in yaml.safe_load_all((DEPLOY / folder / name).read_text())
        if item and item["kind"] != "Namespace"
    }
    made = rendered(values)
    config = yaml.safe_load(made.pop(("ConfigMap", "magic-config"))["data"]["server.yaml"])
    assert config == read(DEPLOY / folder / "config.yaml")
    assert set(made) == set(wanted)
    for name, item in made.items():
        assert comparable(item) == wanted[name], name


# What the objects say


@pytest.mark.parametrize("values", VARIANTS.values(), ids=VARIANTS)
def test_objects_follow_the_schemas_of_kubernetes(values: Values) -> None:
    for (kind, name), item in rendered(values).items():
        if kind != "ServiceMonitor":  # of the Prometheus operator
            kubernetes_validate.validate(item, "1.33", strict=True)
        assert item["metadata"]["labels"]["helm.sh/chart"].startswith("magic-slam-"), name


@pytest.mark.parametrize("values", VARIANTS.values(), ids=VARIANTS)
def test_servers_and_workers_understand_what_they_are_told(values: Values, tmp_path: Path) -> None:
    objects = rendered(values)
    config = config_of(objects, tmp_path)
    pod, container = pod_of(objects["StatefulSet", "magic-server"])
    arguments = [word.replace("$(POD)", "magic-server-0") for word in container["args"]]
    assert arguments[:3] == ["serve", "--config", "/etc/magic/server.yaml"]
    told = parse_command([*arguments[:2], str(tmp_path / "server.yaml"), *arguments[3:]])
    assert isinstance(told, ServeCommand)
    assert told.jobs == config.jobs
    ports = {port["name"]: port["containerPort"] for port in container["ports"]}
    assert ports == {
        "grpc": told.listen.port, "health": told.health.port, "metrics": told.metrics.port
    }  # fmt: skip
    asked = {probe: container[f"{probe}Probe"]["grpc"] for probe in ("startup", "liveness",
                                                                     "readiness")}  # fmt: skip
    assert {probe["port"] for probe in asked.values()} == {told.health.port}
    assert [probe["service"] for probe in asked.values()] == [LIVENESS, LIVENESS, READINESS]
    assert pod["terminationGracePeriodSeconds"] > 2 * told.listen.stop_grace_s
    for kind, name in objects:
        if kind == "Deployment" and name != "magic-scheduler":
            _, worker = pod_of(objects[kind, name])
            words = [word for word in worker["args"] if not word.startswith("--data-dir")]
            command = parse_command(words)
            assert isinstance(command, WorkerCommand)
            assert command.scheduler == told.jobs.scheduler
            assert command.tls == told.jobs.tls
            asked_for = parse_resources(told.jobs.merge_resources, field="merge_resources")
            offered = parse_resources(command.resources, field="resources")
            assert (offered == asked_for) == (name == "magic-worker-gpu" or not asked_for)


@pytest.mark.parametrize("values", VARIANTS.values(), ids=VARIANTS)
def test_everything_that_is_mounted_is_there(values: Values) -> None:
    for (kind, name), item in rendered(values).items():
        if kind in ("StatefulSet", "Deployment"):
            pod, container = pod_of(item)
            claims = item["spec"].get("volumeClaimTemplates", ())
            there = [volume["name"] for volume in pod["volumes"]]
            there += [claim["metadata"]["name"] for claim in claims]
            mounted = {mount["name"]: mount["mountPath"] for mount in container["volumeMounts"]}
            assert len(container["volumeMounts"]) == len(mounted) == len(set(mounted.values()))
            assert sorted(mounted) == sorted(there), name
            folders = tuple(f"{path}/" for path in mounted.values())
            for word in container["args"]:
                path = word.rpartition("=")[2]
                assert not path.startswith("/") or f"{path}/".startswith(folders), word


@pytest.mark.parametrize("values", [CLUSTER, EVERYTHING], ids=["cluster", "everything"])
def test_dask_understands_what_the_scheduler_is_told(values: Values, tmp_path: Path) -> None:
    objects = rendered(values)
    _, container = pod_of(objects["Deployment", "magic-scheduler"])
    assert container["command"] == ["dask", "scheduler"]
    files = {word.partition("=")[2] for word in container["args"] if "=/" in word}
    here = tmp_path / "file"
    here.touch()
    arguments = [re.sub(r"=/.*", f"={here}", word) for word in container["args"]]
    told = dask_scheduler.make_context("dask scheduler", arguments).params
    config = config_of(objects, tmp_path)
    scheme, _, host = config.jobs.scheduler.partition("://")
    assert (told["protocol"] or "tcp", f"magic-scheduler.magic.svc:{told['port']}") == (
        scheme,
        host,
    )
    tls = (config.jobs.tls.ca, config.jobs.tls.certificate, config.jobs.tls.key)
    assert files == {str(path) for path in tls if path is not None}


def test_settings_reach_the_server_as_they_were_written(tmp_path: Path) -> None:
    config = config_of(rendered(EVERYTHING), tmp_path)
    assert config.registration.min_overlap == 1e-7
    assert config.quotas.session_bytes == 50_000_000_000
    assert (config.cluster.lease_s, config.logs.format) == (8.0, "text")
    assert config.store.blob_cache_bytes == 8_000_000_000


def test_another_config_rolls_the_servers_and_nothing_else_does() -> None:
    def mark(values: Values) -> str:
        server = rendered(merged(ONE, values))["StatefulSet", "magic-server"]
        return server["spec"]["template"]["metadata"]["annotations"]["checksum/config"]

    before = mark({})
    assert mark({"metrics": {"serviceMonitor": {"enabled": True}}}) == before
    assert mark({"server": {"config": {"jobs": {"workers": 3}}}}) != before


def test_each_of_several_servers_is_reached_from_outside() -> None:
    objects = rendered(EVERYTHING)
    for ordinal in range(3):
        pod = f"magic-server-{ordinal}"
        service = objects["Service", pod]
        assert service["spec"]["selector"]["statefulset.kubernetes.io/pod-name"] == pod
        assert list(service["metadata"]["annotations"].values()) == [f"{pod}.maps.example"]
        _, container = pod_of(objects["StatefulSet", "magic-server"])
        (address,) = (word for word in container["args"] if "cluster.address" in word)
        assert address.replace("$(POD)", pod).endswith(f"={pod}.maps.example:50051")


def test_the_operator_scrapes_the_servers_as_the_alerts_expect() -> None:
    objects = rendered(EVERYTHING)
    monitor = objects["ServiceMonitor", "magic-server"]["spec"]
    service = objects["Service", "magic-server"]
    assert monitor["selector"]["matchLabels"].items() <= service["metadata"]["labels"].items()
    (endpoint,) = monitor["endpoints"]
    assert endpoint["port"] in {port["name"] for port in service["spec"]["ports"]}
    job = service["metadata"]["labels"][monitor["jobLabel"]]
    assert f'up{{job="{job}"}}' in (DEPLOY / "monitoring" / "alerts.yaml").read_text()
    template = objects["StatefulSet", "magic-server"]["spec"]["template"]
    assert "prometheus.io/scrape" not in template["metadata"]["annotations"]


def test_workers_that_scale_by_themselves_have_no_number() -> None:
    objects = rendered(EVERYTHING)
    scaled = objects["HorizontalPodAutoscaler", "magic-worker"]["spec"]["scaleTargetRef"]
    assert "replicas" not in objects[scaled["kind"], scaled["name"]]["spec"]
    assert objects["Deployment", "magic-worker-gpu"]["spec"]["replicas"] == 1


def test_two_releases_share_a_namespace_without_meeting() -> None:
    first, second = (rendered(EVERYTHING, release=name) for name in ("north", "south"))
    assert not set(first) & set(second)
    for kind, name in first:
        if kind in ("Service", "NetworkPolicy"):
            spec = first[kind, name]["spec"]
            chosen = spec.get("selector") or spec["podSelector"]["matchLabels"]
            assert chosen["app.kubernetes.io/instance"] == "north"


# What the user is told


@pytest.mark.parametrize(
    ("values", "addresses", "certificate"),
    [
        (ONE, ["magic-server.magic.svc:50051"], "magic-server.magic.svc."),
        (CLUSTER, [f"magic-server-{i}.magic-server.magic.svc:50051" for i in range(2)],
         "*.magic-server.magic.svc."),
        (EVERYTHING, [f"magic-server-{i}.maps.example:50051" for i in range(3)],
         "magic-server-0.maps.example, magic-server-1.maps.example, magic-server-2.maps.example."),
    ],
    ids=["one-server", "cluster", "everything"],
)  # fmt: skip
def test_the_notes_name_addresses_and_secrets(
    values: Values, addresses: list[str], certificate: str
) -> None:
    made = helm(
        "install", "magic", CHART, "--namespace", "magic", "--dry-run=client",
        "--kube-apiserver", "http://127.0.0.1:1", values=yaml.safe_dump(values),
    )  # fmt: skip
    if "cluster unreachable" in made.stderr:
        pytest.skip("helm 3 shows the notes to a cluster alone; helm 4 to everyone")
    assert made.returncode == 0, made.stderr
    notes = made.stdout.partition("\nNOTES:\n")[2]
    (line,) = re.findall(r"--server \S+", notes)
    agent: Any = parse_command(["agent", "DATASET", *line.split()])
    assert agent.server.split(",") == addresses
    assert f"carries {certificate}" in notes
    secrets = set(re.findall(r"(?:secretName|name): \"?([\w-]+)\"?", made.stdout))
    for secret in re.findall(r"^  ([\w-]+): ", notes.partition("secrets exist")[2], re.MULTILINE):
        assert secret in secrets
