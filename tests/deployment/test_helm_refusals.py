"""Values that do not fit together are refused by the chart, with what helps."""

from __future__ import annotations

import re

import pytest
import yaml

from magic_cli.serve import ServeCommand
from tests.commands import parse_command
from tests.helm import CLUSTER, Values, merged, nested, pod_of, refusal, rendered


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"server": {"replicas": 2}}, r"server\.replicas: 2 servers share.*database\.secret"),
        ({"server": {"replicas": 2}, "database": {"secret": "db"}}, r"give .*bucket\.url"),
        ({"dask": {"enabled": True}}, r"dask\.enabled: .*give bucket\.url"),
        ({"gpuWorker": {"enabled": True}}, r"gpuWorker\.enabled: .*set dask\.enabled"),
        ({"dask": {"tls": {"secret": "x"}}}, r"dask\.tls\.secret: .*dask\.enabled"),
        ({"bucket": {"endpoint": "https://s3.example"}}, r"bucket\.url: .*give s3://"),
        ({"tls": {"enabled": False}}, r"tokens\.enabled: .*unencrypted"),
        ({"tls": {"enabled": False, "clientCa": True}}, r"tls\.clientCa: .*tls\.enabled"),
        (merged(CLUSTER, nested("server.service.type", "LoadBalancer")),
         r"server\.service\.type: LoadBalancer .*servicePerReplica"),
        (nested("server.service.sourceRanges", ["192.0.2.0/24"]), r"set server\.service\.type"),
        (merged(CLUSTER, nested("server.storage.existingClaim", "x")), r"each server has a volume"),
        ({"server": {"address": "map.example:50051"}}, r"server\.address: .*database\.secret"),
        (merged(CLUSTER, nested("server.address", "map.example:50051")), r"write \$\(POD\) where"),
        (merged(CLUSTER, nested("server.servicePerReplica.enabled", True)), r"names inside the cl"),
        (nested("server.servicePerReplica.enabled", True), r"for one use server\.service\.type"),
        (merged(CLUSTER, nested("worker.autoscaling",
         {"enabled": True, "minReplicas": 9, "maxReplicas": 3})), r"minReplicas 9 is above max"),
        (nested("server.config.listen.port", 1), r"config\.listen\.port: .*server\.service"),
        (nested("server.config.data_dir", "/x"), r"server\.config\.data_dir: .*server\.storage"),
        (nested("server.config.store.blobs", "s3://x"), r"use the value bucket\.url"),
        ({"fullnameOverride": "1st"}, r"fullnameOverride: .*a letter first"),
        ({"fullnameOverride": "m" * 41}, r"has 41 characters, and 40 is the most"),
        ({"server": {"replcas": 2}}, r"replcas"),
        ({"server": {"config": None}}, r"config"),
    ],
)  # fmt: skip
def test_values_that_do_not_fit_are_refused_with_what_helps(values: Values, said: str) -> None:
    assert re.search(said, refusal(values), re.DOTALL)


def test_settings_that_the_chart_writes_are_not_written_twice() -> None:
    config = yaml.safe_load(rendered(CLUSTER)["ConfigMap", "magic-config"]["data"]["server.yaml"])
    written = {"data_dir"} | {
        f"{section}.{key}" for section, keys in config.items() if isinstance(keys, dict)
        for key in keys
    }  # fmt: skip
    for setting in written - {"logs.format"}:  # a default, and free
        said = refusal(nested(f"server.config.{setting}", "x"))
        assert "the chart writes it; use the value" in said, setting


def test_a_servers_name_is_as_long_as_the_server_takes() -> None:
    longest = "m" * (31 - len("-server-0"))
    objects = rendered(CLUSTER, release=longest)
    _, container = pod_of(objects["StatefulSet", f"{longest}-server"])
    words = [word.replace("$(POD)", f"{longest}-server-0") for word in container["args"]]
    told = parse_command(["serve", *words[3:]])
    assert isinstance(told, ServeCommand)
    assert told.cluster.replica == f"{longest}-server-0"
    assert "31 is the most" in refusal(CLUSTER, release=f"{longest}m")
