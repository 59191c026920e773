"""The chart of deploy/helm: its files, and what the real `helm` makes of values."""

from __future__ import annotations

import copy
import functools
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
import yaml

CHART = Path(__file__).resolve().parents[1] / "deploy" / "helm" / "magic-slam"
EXAMPLES = {path.stem: path for path in sorted((CHART / "examples").glob("*.yaml"))}

Values = dict[str, Any]


def read(path: Path) -> Values:
    return yaml.safe_load(path.read_text())


def merged(below: Values, above: Values) -> Values:
    """Values over others, as helm lays a file over the chart's defaults."""
    result = copy.deepcopy(below)
    for key, value in above.items():
        inner = isinstance(value, dict) and isinstance(result.get(key), dict)
        result[key] = merged(result[key], value) if inner else copy.deepcopy(value)
    return result


def nested(path: str, value: Any) -> Values:
    """`a.b` and a value as a mapping of mappings."""
    for key in reversed(path.split(".")):
        value = {key: value}
    return value


ONE, CLUSTER = (read(EXAMPLES[name]) for name in ("one-server", "cluster"))
EVERYTHING: Values = merged(CLUSTER, {
    "image": {"pullSecrets": ["registry"], "digest": f"sha256:{'0f' * 32}"},
    "tls": {"clientCa": True},
    "tokens": {"key": "callers"},
    "server": {
        "replicas": 3,
        "address": "$(POD).maps.example:50051",
        "servicePerReplica": {
            "enabled": True,
            "annotations": {"external-dns.alpha.kubernetes.io/hostname": "$(POD).maps.example"},
            "sourceRanges": ["192.0.2.0/24", "2001:db8::/32"],
        },
        "config": {
            "cluster": {"lease_s": 8.0}, "registration": {"min_overlap": 0.0000001},
            "quotas": {"session_bytes": 50000000000}, "logs": {"format": "text"},
        },
        "storage": {"className": "fast"},
        "env": [{"name": "AWS_CA_BUNDLE", "value": "/etc/s3/ca.pem"}],
        "extraVolumes": [{"name": "s3-ca", "configMap": {"name": "s3-ca"}}],
        "extraVolumeMounts": [{"name": "s3-ca", "mountPath": "/etc/s3", "readOnly": True}],
        "podAnnotations": {"example.org/team": "maps"}, "podLabels": {"team": "maps"},
        "affinity": {"podAntiAffinity": {"preferredDuringSchedulingIgnoredDuringExecution": []}},
        "priorityClassName": "high",
    },
    "dask": {"tls": {"secret": "dask-tls"}},
    "worker": {"autoscaling": {"enabled": True}, "args": ["--threads=2", "--logs.format=json"]},
    "gpuWorker": {
        "runtimeClassName": "nvidia", "nodeSelector": {"gpu": "true"},
        "tolerations": [{"key": "nvidia.com/gpu", "operator": "Exists", "effect": "NoSchedule"}],
    },
    "metrics": {"scrapeAnnotations": False, "serviceMonitor": {
        "enabled": True, "labels": {"release": "prometheus"}}},
    "networkPolicy": {"callers": [{"ipBlock": {"cidr": "192.0.2.0/24"}}]},
    "serviceAccount": {"create": True, "annotations": {"eks.amazonaws.com/role-arn": "arn"}},
})  # fmt: skip
PLAINTEXT: Values = {
    "tls": {"enabled": False}, "tokens": {"enabled": False}, "networkPolicy": {"enabled": False},
    "server": {"service": {"type": "LoadBalancer", "sourceRanges": ["192.0.2.0/24"]},
               "storage": {"existingClaim": "maps"}},
    "podSecurityContext": {"runAsUser": None, "runAsGroup": None, "fsGroup": None},
}  # fmt: skip
WORKERS: Values = {
    "bucket": {"url": "s3://robots/maps", "region": "eu-west-1"}, "dask": {"enabled": True},
}  # fmt: skip
VARIANTS = {"defaults": {}, "one-server": ONE, "cluster": CLUSTER, "everything": EVERYTHING,
            "plaintext": PLAINTEXT, "workers": WORKERS}  # fmt: skip


def helm(*arguments: object, values: str = "") -> subprocess.CompletedProcess[str]:
    """Run helm on values in YAML, beside every cluster; skips where there is no helm."""
    program = os.environ.get("HELM") or shutil.which("helm")
    if program is None:
        pytest.skip(
            "helm is not here (https://helm.sh/docs/intro/install): put it on PATH or name it in "
            "HELM; the chart's values are checked, its objects are not"
        )
    return subprocess.run(
        [program, *map(str, arguments), "--values", "-"], input=values, capture_output=True,
        text=True, check=False, env={**os.environ, "KUBECONFIG": os.devnull},
    )  # fmt: skip


@functools.cache
def _template(values: str, release: str, namespace: str) -> subprocess.CompletedProcess[str]:
    return helm("template", release, CHART, "--namespace", namespace, values=values)


def rendered(
    values: Values, *, release: str = "magic", namespace: str = "magic"
) -> dict[tuple[str, str], dict[str, Any]]:
    """The objects of a release by kind and name."""
    made = _template(yaml.safe_dump(values), release, namespace)
    assert made.returncode == 0, made.stderr
    objects = [item for item in yaml.safe_load_all(made.stdout) if item]
    found = {(item["kind"], item["metadata"]["name"]): item for item in objects}
    assert len(found) == len(objects)
    return found


def refusal(values: Values, *, release: str = "magic") -> str:
    """What helm says of values that it must not take."""
    made = _template(yaml.safe_dump(values), release, "magic")
    assert made.returncode != 0
    assert made.stdout == ""
    return made.stderr


def pod_of(item: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """The pod of a set or deployment, and its one container."""
    pod = item["spec"]["template"]["spec"]
    (container,) = pod["containers"]
    return pod, container
