"""What deploy/ holds for several servers, workers, PostgreSQL and a bucket agrees with itself."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import kubernetes_validate
import pytest
import yaml

from magic_cli.serve import ServeCommand
from magic_cli.worker import WorkerCommand
from magic_core.config import load_yaml
from magic_server.jobs.config import parse_resources
from magic_server.server import LIVENESS, READINESS
from tests.commands import parse_command

DEPLOY = Path(__file__).resolve().parents[2] / "deploy"
COMPOSE, KUBERNETES = DEPLOY / "cluster" / "compose.yaml", DEPLOY / "kubernetes-cluster"
MANIFESTS = ("servers.yaml", "workers.yaml", "network-policy.yaml")


def documents(name: str) -> list[dict[str, Any]]:
    return [item for item in yaml.safe_load_all((KUBERNETES / name).read_text()) if item]


def named(kind: str, name: str) -> dict[str, Any]:
    """The one resource of a kind and name."""
    found = [
        item
        for manifest in MANIFESTS
        for item in documents(manifest)
        if (item["kind"], item["metadata"]["name"]) == (kind, name)
    ]
    (one,) = found
    return one


def pod_of(kind: str, name: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """A pod's specification and its one container."""
    pod = named(kind, name)["spec"]["template"]["spec"]
    (container,) = pod["containers"]
    return pod, container


# Docker


def test_the_compose_file_follows_its_schema() -> None:
    subprocess.run(
        [sys.executable, "-m", "check_jsonschema", "--builtin-schema", "vendor.compose-spec",
         str(COMPOSE)],
        check=True, capture_output=True,
    )  # fmt: skip


def test_the_compose_file_starts_servers_and_workers_that_find_each_other() -> None:
    compose = yaml.safe_load(COMPOSE.read_text())
    services = compose["services"]
    servers = {name: parse_command(services[f"server_{name}"]["command"]) for name in "ab"}
    for name, server in servers.items():
        assert isinstance(server, ServeCommand)
        assert server.cluster.replica == name
        outside = services[f"server_{name}"]["ports"][0].rpartition(":")[0]
        assert server.cluster.address == outside
        host, _, port = server.store.s3_endpoint.removeprefix("http://").partition(":")
        assert (host, port) == ("bucket", "9000")
        assert "s3/magic" in services["make-bucket"]["command"][0]
        assert server.store.blobs.startswith("s3://magic/")
        environment = services[f"server_{name}"]["environment"]
        user, secret, database = (
            services["database"]["environment"][f"POSTGRES_{key}"]
            for key in ("USER", "PASSWORD", "DB")
        )
        wanted = f"postgresql+asyncpg://{user}:{secret}@database/{database}"
        assert environment[server.store.database_env] == wanted
    assert servers["a"].store == servers["b"].store
    worker = parse_command(services["worker"]["command"])
    assert isinstance(worker, WorkerCommand)
    assert worker.scheduler == servers["a"].jobs.scheduler == servers["b"].jobs.scheduler
    assert services["scheduler"]["command"][1] == worker.scheduler.rpartition(":")[2]
    given = services["bucket"]["environment"]["MINIO_ROOT_PASSWORD"]
    for name in ("worker", "server_a", "server_b"):
        assert services[name]["environment"]["AWS_SECRET_ACCESS_KEY"] == given
        assert services[name]["build"]["args"] == {"EXTRAS": "[cluster]"}
    mine, theirs = (set(services[f"server_{name}"]["volumes"]) for name in "ab")
    assert not mine & theirs  # no folder is shared
    for service in services.values():
        assert set(service.get("depends_on", {})) <= set(services)


# Kubernetes


@pytest.mark.parametrize("name", MANIFESTS)
def test_manifests_follow_the_schemas_of_kubernetes(name: str) -> None:
    for document in documents(name):
        kubernetes_validate.validate(document, "1.33", strict=True)


def test_the_kustomization_names_every_manifest_and_image() -> None:
    listed = yaml.safe_load((KUBERNETES / "kustomization.yaml").read_text())
    assert sorted(listed["resources"]) == sorted(MANIFESTS)
    (generated,) = listed["configMapGenerator"]
    assert generated["files"] == ["server.yaml=config.yaml"]
    pods = [pod_of("StatefulSet", "magic-server")]
    pods += [
        pod_of("Deployment", f"magic-{name}") for name in ("scheduler", "worker", "worker-gpu")
    ]
    images = {container["image"] for _, container in pods}
    assert images == {image["name"] for image in listed["images"]}


def test_the_kustomization_builds() -> None:
    if shutil.which("kubectl") is None:
        pytest.skip("kubectl is not here: the parts are checked, their sum is not")
    built = subprocess.run(
        ["kubectl", "kustomize", str(KUBERNETES)], capture_output=True, text=True, check=True
    )
    made = [document for document in yaml.safe_load_all(built.stdout) if document]
    assert len(made) == 1 + sum(len(documents(name)) for name in MANIFESTS)
    for document in made:
        kubernetes_validate.validate(document, "1.33", strict=True)
        if "template" in document.get("spec", {}):
            (container,) = document["spec"]["template"]["spec"]["containers"]
            assert container["image"].endswith(":latest"), container["image"]


def test_servers_are_told_who_they_are_and_where_everything_is() -> None:
    config = load_yaml(ServeCommand, KUBERNETES / "config.yaml")
    pod, container = pod_of("StatefulSet", "magic-server")
    arguments = [word.replace("$(POD)", "magic-server-0") for word in container["args"]]
    assert arguments[:2] == ["serve", "--config"]
    told = parse_command(["serve", *arguments[3:]])
    assert told.cluster.replica == "magic-server-0"
    service = named("Service", "magic-server")
    assert service["spec"]["clusterIP"] == "None"  # each server has a name of its own
    assert told.cluster.address == (
        f"magic-server-0.{service['metadata']['name']}.magic.svc:{config.listen.port}"
    )
    variables = {entry["name"] for entry in container["env"]}
    assert config.store.database_env in variables
    ports = {port["name"]: port["containerPort"] for port in container["ports"]}
    assert ports == {
        "grpc": config.listen.port, "health": config.health.port, "metrics": config.metrics.port
    }  # fmt: skip
    for probe, asked in (
        ("startupProbe", LIVENESS), ("livenessProbe", LIVENESS), ("readinessProbe", READINESS)
    ):  # fmt: skip
        assert container[probe]["grpc"] == {"port": config.health.port, "service": asked}
    assert pod["terminationGracePeriodSeconds"] > 2 * config.listen.stop_grace_s
    mounts = {mount["name"]: Path(mount["mountPath"]) for mount in container["volumeMounts"]}
    assert config.data_dir.parent == mounts["data"]
    assert Path(container["args"][2]) == mounts["config"] / "server.yaml"
    assert config.tls.certificate == mounts["tls"] / "tls.crt"
    assert config.access.tokens_file == mounts["tokens"] / "tokens"


@pytest.mark.parametrize("name", ["magic-worker", "magic-worker-gpu"])
def test_workers_find_the_scheduler_and_the_bucket(name: str) -> None:
    config = load_yaml(ServeCommand, KUBERNETES / "config.yaml")
    pod, container = pod_of("Deployment", name)
    arguments = [word for word in container["args"] if not word.startswith("--data-dir")]
    worker = parse_command(arguments)
    assert isinstance(worker, WorkerCommand)
    assert worker.scheduler == config.jobs.scheduler
    service = named("Service", "magic-scheduler")
    host, _, port = worker.scheduler.removeprefix("tcp://").partition(":")
    assert host.split(".")[0] == service["metadata"]["name"]
    assert int(port) in {entry["port"] for entry in service["spec"]["ports"]}
    _, server = pod_of("StatefulSet", "magic-server")
    assert container["envFrom"] == server["envFrom"]
    (folder,) = [word.partition("=")[2] for word in container["args"] if "--data-dir" in word]
    assert {"name": "work", "mountPath": folder} in container["volumeMounts"]
    (room,) = [volume for volume in pod["volumes"] if volume["name"] == "work"]
    assert (
        int(room["emptyDir"]["sizeLimit"].removesuffix("Gi")) << 30 > config.store.blob_cache_bytes
    )
    asked = parse_resources(config.jobs.merge_resources, field="jobs.merge_resources")
    offered = parse_resources(worker.resources, field="resources")
    assert (asked == offered) == (name == "magic-worker-gpu")
    assert ("nvidia.com/gpu" in container["resources"]["limits"]) == bool(offered)


def test_policies_and_services_meet_the_pods_that_they_are_for() -> None:
    components = {
        name: named(kind, name)["spec"]["template"]["metadata"]["labels"]
        for kind, name in (
            ("StatefulSet", "magic-server"), ("Deployment", "magic-scheduler"),
            ("Deployment", "magic-worker"), ("Deployment", "magic-worker-gpu"),
        )
    }  # fmt: skip
    labels = {item["app.kubernetes.io/component"] for item in components.values()}
    (chosen,) = named("NetworkPolicy", "magic-workers")["spec"]["podSelector"]["matchExpressions"]
    assert set(chosen["values"]) == labels - {"server"}
    policy = named("NetworkPolicy", "magic-server")["spec"]["podSelector"]["matchLabels"]
    assert policy == components["magic-server"]
    for service in ("magic-server", "magic-scheduler"):
        assert named("Service", service)["spec"]["selector"] == components[service]
