"""The chart's values are explained, bounded and strict: checked without helm."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Iterator
from typing import Any

import jsonschema
import pytest

from magic_core.config import field_names, to_mapping
from magic_core.errors import ConfigError
from magic_server.config import ServerConfig
from magic_server.store_config import StoreConfig
from tests.helm import CHART, EXAMPLES, Values, merged, nested, read

SCHEMA: dict[str, Any] = json.loads((CHART / "values.schema.json").read_text())
DEFAULTS = read(CHART / "values.yaml")


def refused(values: Values) -> bool:
    """Whether the schema refuses values laid over the defaults."""
    whole = merged(DEFAULTS, values)
    return not jsonschema.Draft7Validator(SCHEMA).is_valid(whole)


def fixed(schema: dict[str, Any], path: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    """Every object of the schema whose keys are all the chart's own, with its path."""
    yield path, schema
    for key, inner in schema["properties"].items():
        if "required" in inner:
            yield from fixed(inner, f"{path}.{key}".lstrip("."))


def at(path: str) -> Values:
    found = DEFAULTS
    for key in filter(None, path.split(".")):
        found = found[key]
    return found


# The files


def test_the_chart_is_of_this_package() -> None:
    chart = read(CHART / "Chart.yaml")
    project = tomllib.loads((CHART.parents[2] / "pyproject.toml").read_text())["project"]
    assert (chart["apiVersion"], chart["name"]) == ("v2", CHART.name)
    assert chart["name"] == project["name"]
    assert chart["appVersion"] == project["version"]
    assert chart["annotations"]["artifacthub.io/license"] == project["license"]


def test_the_schema_and_the_defaults_have_the_same_keys() -> None:
    jsonschema.Draft7Validator.check_schema(SCHEMA)
    for path, schema in fixed(SCHEMA):
        assert schema["additionalProperties"] is False, path
        assert schema["required"] == list(at(path)), path
        assert set(schema["properties"]) - {"global"} == set(at(path)), path


def test_every_value_has_a_comment() -> None:
    lines = (CHART / "values.yaml").read_text().splitlines()
    for path, schema in fixed(SCHEMA):
        for key in schema["required"]:
            if "required" in schema["properties"][key]:
                continue
            depth = "  " * len(path.split(".")) if path else ""
            start = 0
            for parent in filter(None, path.split(".")):
                indent = "  " * path.split(".").index(parent)
                start = lines.index(f"{indent}{parent}:", start)
            (number, line) = next(
                (n, line) for n, line in enumerate(lines[start:], start)
                if line.startswith(f"{depth}{key}:")
            )  # fmt: skip
            below = lines[number + 1] if line.endswith(":") else ""
            explained = "  # " in line or any("# " in near for near in (lines[number - 1], below))
            assert explained, f"{path}.{key}"


@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example_sets_values_that_exist(name: str) -> None:
    assert not refused(read(EXAMPLES[name]))


def test_the_examples_are_the_two_topologies() -> None:
    assert set(EXAMPLES) == {"one-server", "cluster"}


# What is refused


@pytest.mark.parametrize("path", [path for path, _ in fixed(SCHEMA)])
def test_an_unknown_key_is_refused_wherever_it_stands(path: str) -> None:
    assert refused(nested(f"{path}.unknown".lstrip("."), 1))


@pytest.mark.parametrize(
    "path",
    ["podSecurityContext", "containerSecurityContext", "server.config", "worker.resources",
     "worker.affinity"],
)  # fmt: skip
def test_a_key_that_kubernetes_or_the_server_lacks_is_refused(path: str) -> None:
    assert refused(nested(f"{path}.unknown", {}))


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("image.tag", "a b"), ("image.digest", "sha256:12"), ("image.pullPolicy", "Sometimes"),
        ("tls.secret", ""), ("tls.secret", "Magic_TLS"), ("tokens.key", "../tokens"),
        ("tls.enabled", "yes"), ("server.replicas", 0), ("server.replicas", 1.5),
        ("server.replicas", "2"), ("server.address", "map.example"),
        ("server.storage.size", "many"), ("server.service.type", "Ingress"),
        ("server.service.sourceRanges", ["everywhere"]), ("server.env", [{"value": "x"}]),
        ("server.env", [{"name": "X", "valeu": "x"}]), ("server.stopGraceSeconds", 0),
        ("server.podLabels", {"app.kubernetes.io/name": "x"}), ("worker.replicas", -1),
        ("worker.processes", 0), ("worker.args", ["sleep 1000"]), ("worker.scratch", ""),
        ("worker.resources.limits.cpu", "two"), ("bucket.cacheBytes", -1),
        ("metrics.serviceMonitor.interval", "15"), ("networkPolicy.callers", [{}]),
        ("networkPolicy.metricsNamespaces", [""]), ("podSecurityContext.runAsUser", "root"),
        ("extraVolumes", []), ("server.extraVolumes", [{"emptyDir": {}}]),
    ],
)  # fmt: skip
def test_a_wrong_value_is_refused(path: str, value: object) -> None:
    assert refused(nested(path, value))


@pytest.mark.parametrize(
    ("url", "endpoint"),
    [
        ("s3://robots/maps/2026", "https://s3.example:9000"), ("s3://robots", "http://[::1]:9000"),
        ("s3://robots", ""), ("http://robots/maps", ""), ("s3://robots/a b", ""), ("s3://r", ""),
        ("s3://robots", "s3.example:9000"), ("s3://robots", "https://key:secret@s3.example"),
        ("s3://key:secret@robots", ""), ("s3://robots", "https://s3.example/path"),
    ],
)  # fmt: skip
def test_the_schema_takes_the_buckets_that_the_server_takes(url: str, endpoint: str) -> None:
    try:
        StoreConfig(blobs=url, s3_endpoint=endpoint)
        taken = True
    except ConfigError:
        taken = False
    assert refused({"bucket": {"url": url, "endpoint": endpoint}}) is not taken


def test_every_section_of_the_servers_settings_can_be_given() -> None:
    assert set(SCHEMA["definitions"]["config"]["properties"]) == set(field_names(ServerConfig))


def test_what_the_chart_refuses_in_the_config_has_a_value_instead() -> None:
    checks = (CHART / "templates" / "_check.tpl").read_text()
    named = re.findall(r'^  "([a-z0-9_.]+)" "([\w.]+)"$', checks, re.MULTILINE)
    assert len(named) > 20
    known = to_mapping(ServerConfig())
    for setting, value in named:
        section, _, key = setting.partition(".")
        assert not key or key in known[section], setting
        at(value)
