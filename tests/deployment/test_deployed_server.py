"""The server as deploy/ starts it: from the unit's command and config, with the script's keys."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import json
import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import urllib.request
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import grpc.aio
import pytest
import yaml
from grpc_health.v1 import health_pb2, health_pb2_grpc

from magic_agent.client import ClientConfig, MagicClient
from magic_core.errors import PermissionDenied, Unauthenticated, Unavailable
from magic_core.wire import ClientCredentials
from magic_server.config import ServerConfig
from magic_server.health_port import HealthPortConfig
from magic_server.server import Server
from tests.small_world import DIMENSION, MODEL_ID

DEPLOY = Path(__file__).resolve().parents[2] / "deploy"
SYSTEMD = DEPLOY / "systemd"
PATIENCE_S = 240.0
"""For a machine that is busy with other things; nothing waits so long otherwise."""
SERVING = health_pb2.HealthCheckResponse.SERVING
TOKEN = "a-token-of-a-robot-0123456789"


@pytest.fixture(scope="module")
def certificates(tmp_path_factory) -> Path:
    """What the script makes for a server on this machine and one robot."""
    folder = tmp_path_factory.mktemp("certificates")
    make_certificates(folder, "map.example", "robot_1")
    return folder


def make_certificates(*arguments: object) -> str:
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not installed")
    command = [str(DEPLOY / "make-certificates"), *map(str, arguments)]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def openssl(*arguments: object) -> str:
    command = ["openssl", *map(str, arguments)]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


# Certificates


def test_the_script_makes_keys_that_only_their_owner_reads(certificates: Path) -> None:
    for key in certificates.glob("*.key"):
        assert key.stat().st_mode & 0o077 == 0
    assert {path.suffix for path in certificates.iterdir()} <= {".pem", ".key", ".srl"}


def test_its_certificates_are_valid_for_what_they_are(certificates: Path) -> None:
    ca = certificates / "ca.pem"
    for name, purpose in (("server", "sslserver"), ("robot_1", "sslclient")):
        openssl("verify", "-x509_strict", "-purpose", purpose, "-CAfile", ca,
                certificates / f"{name}.pem")  # fmt: skip
    openssl("verify", "-verify_hostname", "map.example", "-CAfile", ca, certificates / "server.pem")
    openssl("verify", "-verify_ip", "127.0.0.1", "-CAfile", ca, certificates / "server.pem")
    for name, purpose in (("server", "sslclient"), ("robot_1", "sslserver")):
        with pytest.raises(subprocess.CalledProcessError):
            openssl("verify", "-purpose", purpose, "-CAfile", ca, certificates / f"{name}.pem")


def test_a_client_is_added_later_and_nothing_else_changes(tmp_path: Path) -> None:
    make_certificates(tmp_path, "192.0.2.7")
    before = {path.name: path.read_bytes() for path in tmp_path.glob("*.pem")}
    assert "robot_2.pem" in make_certificates(tmp_path, "192.0.2.7", "robot_2")
    for name, content in before.items():
        assert (tmp_path / name).read_bytes() == content
    openssl("verify", "-verify_ip", "192.0.2.7", "-CAfile", tmp_path / "ca.pem",
            tmp_path / "server.pem")  # fmt: skip
    openssl("verify", "-CAfile", tmp_path / "ca.pem", tmp_path / "robot_2.pem")


# The units


def unit(name: str) -> dict[str, list[str]]:
    """The settings of a unit, each with its values in order."""
    found: dict[str, list[str]] = {}
    for line in (SYSTEMD / name).read_text().splitlines():
        if line and line[0] not in "#[":
            key, _, value = line.partition("=")
            found.setdefault(key, []).append(value)
    return found


@pytest.mark.parametrize(
    ("name", "exposure"), [("magic-server.service", 20), ("magic-agent@.service", 30)]
)
def test_systemd_finds_nothing_wrong_with_a_unit(name: str, exposure: int, tmp_path: Path) -> None:
    if shutil.which("systemd-analyze") is None:
        pytest.skip("systemd is not installed")
    text = (SYSTEMD / name).read_text()
    # What the unit names exists on a machine where it was installed: the program, the account.
    text = text.replace("/opt/magic-slam/.venv", sys.prefix)
    text = re.sub(r"^(User|Group)=magic$", r"\1=root", text, flags=re.MULTILINE)
    path = tmp_path / name.replace("@", "@robot_1")
    path.write_text(text)
    for command in (
        ("verify", "--man=no"),
        ("security", "--offline=yes", f"--threshold={exposure}"),
    ):
        found = subprocess.run(
            ["systemd-analyze", *command, str(path)], capture_output=True, text=True, check=False
        )
        assert (found.returncode, found.stderr) == (0, ""), found.stdout[-2000:]


# The server


class Deployed:
    """A server that runs as the unit says."""

    def __init__(self, process: asyncio.subprocess.Process, ready: dict[str, Any]) -> None:
        self.process = process
        self.ready = ready

    async def stop(self) -> int:
        self.process.send_signal(signal.SIGTERM)
        async with asyncio.timeout(PATIENCE_S):
            return await self.process.wait()


def place(config: Path, folder: Path, keys: Path, **tls: Path) -> list[str]:
    """The unit's arguments for a config of deploy/, with its files and ports in `folder`."""
    settings = yaml.safe_load(config.read_text())
    settings["data_dir"] = str(folder / "data")
    settings["tls"] = {"certificate": str(keys / "server.pem"), "key": str(keys / "server.key")}
    settings["tls"] |= {name: str(path) for name, path in tls.items()}
    settings["access"]["tokens_file"] = str(folder / "tokens")
    settings["resources"]["min_free_bytes"] = 1
    for port in ("listen", "metrics", "health"):
        settings.setdefault(port, {})["port"] = 0
    (folder / "server.yaml").write_text(yaml.safe_dump(settings))
    (folder / "tokens").write_text(
        f"robot_1 agent:sessions/office/agents/robot_1 {TOKEN}\n"
        "robot_2 agent:sessions/office/agents/robot_2 certificate:robot_1\n"
    )
    (start,) = unit("magic-server.service")["ExecStart"]
    program, *arguments = shlex.split(start)
    assert program.endswith("/bin/magic")
    arguments[arguments.index("--config") + 1] = str(folder / "server.yaml")
    return arguments


@contextlib.asynccontextmanager
async def deployed(config: Path, folder: Path, keys: Path, **tls: Path) -> AsyncIterator[Deployed]:
    """A server as the unit starts it, on a config of deploy/."""
    arguments = place(config, folder, keys, **tls)
    environment = {**os.environ, "NOTIFY_SOCKET": str(folder / "notify")}
    process = await asyncio.create_subprocess_exec(
        str(Path(sys.prefix) / "bin" / "magic"), *arguments, "--progress", "json",
        stdout=asyncio.subprocess.PIPE, env=environment, cwd=folder,
    )  # fmt: skip
    assert process.stdout is not None
    try:
        async with asyncio.timeout(PATIENCE_S):
            ready = json.loads(await process.stdout.readline())
        yield Deployed(process, ready)
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()


def credentials(keys: Path, *, folder: Path | None = None, name: str | None = None):
    """What a robot gives: its token, or its certificate."""
    token = None
    if folder is not None:
        token = folder / "token"
        token.write_text(TOKEN)
    pair = (keys / f"{name}.pem", keys / f"{name}.key") if name else (None, None)
    return ClientCredentials(
        ca=keys / "ca.pem", token_file=token, certificate=pair[0], key=pair[1],
        server_name="map.example",
    )  # fmt: skip


async def register(
    address: str, who: ClientCredentials, agent: str, *, patience_s: float = 60.0
) -> None:
    config = ClientConfig(
        attempts=1, connect_timeout_s=patience_s, rpc_timeout_s=60.0, credentials=who
    )
    async with MagicClient(address, config) as client:
        await client.register_agent("office", agent, model_id=MODEL_ID, dimension=DIMENSION)


async def health(address: str, service: str) -> int:
    """What a probe without TLS is told, as the kubelet asks it."""
    async with grpc.aio.insecure_channel(address) as channel:
        stub = health_pb2_grpc.HealthStub(channel)
        asked = health_pb2.HealthCheckRequest(service=service)
        return (await stub.Check(asked, timeout=20)).status


async def test_a_second_server_does_not_share_the_health_port(
    server_config: ServerConfig, tmp_path: Path
) -> None:
    config = dataclasses.replace(server_config, health=HealthPortConfig(port=0))
    async with Server(config) as first:
        assert await health(str(first.health_address), "") == SERVING
        port = int(str(first.health_address).rpartition(":")[2])
        taken = dataclasses.replace(
            config, data_dir=tmp_path / "other", health=HealthPortConfig(port=port)
        )
        with pytest.raises(Unavailable, match=r"health\.port"):
            async with Server(taken):
                pass
        assert await health(str(first.health_address), "readiness") == SERVING


async def test_the_unit_starts_a_server_that_systemd_is_told_of(
    certificates: Path, tmp_path: Path
) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        async with deployed(DEPLOY / "server.yaml", tmp_path, certificates) as server:
            manager.settimeout(PATIENCE_S)
            told = (await asyncio.to_thread(manager.recv, 4096)).decode()
            assert told.splitlines()[0] == "READY=1"
            assert server.ready["target"] in told
            address = f"localhost:{server.ready['target'].rpartition(':')[2]}"

            await register(address, credentials(certificates, folder=tmp_path), "robot_1")
            with pytest.raises(PermissionDenied):
                await register(address, credentials(certificates, folder=tmp_path), "robot_2")
            with pytest.raises(Unauthenticated):
                await register(address, credentials(certificates), "robot_1")

            # systemctl reload: whoever is put on the list may call.
            (reload,) = unit("magic-server.service")["ExecReload"]
            command = shlex.split(reload.replace("$MAINPID", str(server.process.pid)))
            (tmp_path / "tokens").write_text(f"robot_1 agent:sessions/office {TOKEN}\n")
            assert await (await asyncio.create_subprocess_exec(*command)).wait() == 0
            async with asyncio.timeout(PATIENCE_S):
                while True:
                    with contextlib.suppress(PermissionDenied):
                        who = credentials(certificates, folder=tmp_path)
                        await register(address, who, "robot_2")
                        break
                    await asyncio.sleep(0.05)
            assert await server.stop() == 0


async def test_the_config_of_kubernetes_starts_a_server_with_mutual_tls_that_probes_reach(
    certificates: Path, tmp_path: Path
) -> None:
    config = DEPLOY / "kubernetes" / "config.yaml"
    ca = {"client_ca": certificates / "ca.pem"}
    async with deployed(config, tmp_path, certificates, **ca) as server:
        address = f"localhost:{server.ready['target'].rpartition(':')[2]}"
        await register(address, credentials(certificates, name="robot_1"), "robot_2")
        no_certificate = credentials(certificates, folder=tmp_path)
        with pytest.raises(Unavailable):
            await register(address, no_certificate, "robot_1", patience_s=1.0)

        for service in ("liveness", "readiness", "magicslam.v1.MappingService"):
            assert await health(server.ready["health"], service) == SERVING
        with pytest.raises(grpc.aio.AioRpcError, match="UNIMPLEMENTED"):
            async with grpc.aio.insecure_channel(server.ready["health"]) as channel:
                await channel.unary_unary("/magicslam.v1.SessionService/ListSessions")(b"")
        url = f"http://{server.ready['metrics']}/metrics"
        with await asyncio.to_thread(urllib.request.urlopen, url, timeout=20) as answer:
            assert "magic_ready 1.0" in answer.read().decode()
        assert await server.stop() == 0
