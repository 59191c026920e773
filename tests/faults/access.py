"""Knocks on every door of a real server that should be shut, and counts what it says.

    python -m tests.faults.access --runs 3 --seed 1 --json

Every attempt must be refused with its code, counted by the server's metrics under its reason, and
must leave nothing on its disk. Exits with 1 otherwise.
"""

from __future__ import annotations

import argparse
import asyncio
import dataclasses
import json
import os
import random
import signal
import sys
import tempfile
import urllib.request
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from pathlib import Path

import psutil
from magicslam.v1 import mapping_service_pb2 as mapping_pb
from magicslam.v1 import session_service_pb2 as session_pb
from prometheus_client.parser import text_string_to_metric_families

from magic_agent.client import ClientConfig, MagicClient
from magic_core.config import save_yaml
from magic_core.errors import MagicError
from magic_core.wire import ClientCredentials, EncodedSubmap, encode_submap, geometry, images
from magic_core.wire.chunks import sha256
from magic_server.access import AccessConfig
from magic_server.config import ListenConfig, ServerConfig
from magic_server.jobs import JobConfig
from magic_server.probes import MetricsConfig
from magic_server.tls import TlsConfig
from tests.certificates import Authority
from tests.core.test_wire_image_bounds import bomb_png
from tests.small_world import DIMENSION, MODEL_ID, SMALL, make_submap

REPOSITORY = Path(__file__).resolve().parents[2]
NAMES = (
    "sessions/../agents/agent_0",
    "sessions/room/agents/../../../etc",
    "/etc/passwd",
    "sessions/room/agents/agent_0%2f..%2fagent_1",
    "sessions/room\x00/agents/agent_0",
    "sessions/room/agents/" + "a" * 64,
    "sessions/room/agents/agent_0/submaps/../../agent_1",
    "sessions/\u202eroom/agents/agent_0",
)


@dataclass(slots=True)
class Door:
    """One way in, and what became of those who tried it."""

    code: str
    counter: str
    attempts: int = 0
    refused: int = 0
    counted: int = 0
    answers: dict[str, int] = field(default_factory=dict)

    @property
    def shut(self) -> bool:
        """Whether every attempt was refused with the right code and counted."""
        return self.attempts == self.refused <= self.counted


class Attacker:
    """Clients of one server with all sorts of papers."""

    def __init__(self, address: str, metrics: str, folder: Path, authority: Authority) -> None:
        self.address = address
        self.authority = authority
        self.doors: dict[str, Door] = {}
        self._metrics = metrics
        self._folder = folder

    def client(
        self, token: str | None, credentials: ClientCredentials, address: str | None = None
    ) -> MagicClient:
        """A client that comes back when its connection breaks.

        gRPC's client sometimes loses the answer to a stream that the server ends early, and says
        that the connection broke.
        """
        if token is not None:
            file = self._folder / "token"
            file.write_text(token)
            credentials = dataclasses.replace(credentials, token_file=file)
        config = ClientConfig(
            attempts=3, backoff_s=0.05, rpc_timeout_s=30.0, credentials=credentials
        )
        return MagicClient(address or self.address, config)

    async def knock(
        self,
        door: str,
        client: MagicClient,
        attempt: Callable[[MagicClient], Awaitable[object]],
        *,
        code: str,
        counter: str,
    ) -> None:
        """Try to get in by one door; `counter` is the metric that has to grow."""
        known = self.doors.setdefault(door, Door(code, counter))
        before = (await self.counters()).get(counter, 0.0)
        known.attempts += 1
        try:
            await attempt(client)
            answer = "OK"
        except MagicError as error:
            answer = error.grpc_code
        finally:
            await client.close()
        known.answers[answer] = known.answers.get(answer, 0) + 1
        known.refused += answer == code
        known.counted += await self._grew(counter, before)

    async def counters(self) -> dict[str, float]:
        """The server's counters of refusals by reason, and of failed handshakes by reason."""
        found: dict[str, float] = {}
        for family in text_string_to_metric_families(await asyncio.to_thread(self._scrape)):
            for sample in family.samples:
                if sample.name in ("magic_refusals_total", "magic_tls_handshake_failures_total"):
                    kind = "refused" if "refusals" in sample.name else "handshake"
                    key = f"{kind} {sample.labels['reason']}"
                    found[key] = found.get(key, 0.0) + sample.value
        return found

    async def _grew(self, counter: str, before: float) -> bool:
        for _ in range(100):
            if (await self.counters()).get(counter, 0.0) > before:
                return True
            await asyncio.sleep(0.02)  # a handshake is counted when the core has written its line
        return False

    def _scrape(self) -> str:
        with urllib.request.urlopen(f"http://{self._metrics}/metrics", timeout=20) as answer:
            return answer.read().decode()


class ServeProcess:
    """`magic serve` with a config file."""

    def __init__(self, config: ServerConfig, folder: Path) -> None:
        self._config = config
        self._file = folder / "server.yaml"
        self._log = folder / "server.log"
        self._process: asyncio.subprocess.Process | None = None
        self.ready: dict = {}

    async def __aenter__(self) -> ServeProcess:
        save_yaml(self._config, self._file)
        with self._log.open("wb") as log:
            self._process = await asyncio.create_subprocess_exec(
                sys.executable, "-m", "magic_cli", "serve", "--config", str(self._file),
                "--progress", "json", cwd=REPOSITORY, stdout=asyncio.subprocess.PIPE, stderr=log,
                env={**os.environ, "OMP_NUM_THREADS": "1"},
            )  # fmt: skip
        assert self._process.stdout is not None
        line = await asyncio.wait_for(self._process.stdout.readline(), 120)
        if not line:
            raise SystemExit(f"the server did not start:\n{self._log.read_text()}")
        self.ready = json.loads(line)
        return self

    async def __aexit__(self, *_: object) -> None:
        assert self._process is not None
        self._process.send_signal(signal.SIGTERM)
        await self._process.wait()


def other_address() -> str | None:
    """An address of this machine that is not loopback."""
    for addresses in psutil.net_if_addrs().values():
        for address in addresses:
            if address.family.name == "AF_INET" and not address.address.startswith("127."):
                return address.address
    return None


def with_colour(submap: EncodedSubmap, data: bytes) -> EncodedSubmap:
    """The sub-map with other bytes for its anchor's colour image, PNG, digest and length right."""
    header = type(submap.header).FromString(submap.header.SerializeToString())
    index = header.keyframes[0].colour_blob
    blob = header.blobs[index]
    blob.length, blob.sha256, blob.media_type = len(data), sha256(data), images.PNG
    blobs = tuple(data if i == index else b for i, b in enumerate(submap.blobs))
    return EncodedSubmap(header, blobs)


def bomb_request(width: int, height: int) -> mapping_pb.LocalizeRequest:
    """A small request whose image claims to be large."""
    submap = make_submap()
    return mapping_pb.LocalizeRequest(
        session="sessions/room",
        camera=geometry.camera_to_proto(SMALL),
        colour=bomb_png(width, height),
        colour_media_type=images.PNG,
        depth_png=bomb_png(width, height, depth=True),
        metres_per_unit=0.001,
        image_descriptor=geometry.descriptor_to_proto(submap.descriptor),
    )


async def attack_identity(attacker: Attacker, rng: random.Random, secrets: dict[str, str]) -> None:
    """Wrong, missing and out-of-date papers."""
    good = attacker.authority.client("robot")
    wrong = "".join(rng.choices("0123456789abcdef", k=48))
    near = secrets["ops"][:-1] + chr(ord(secrets["ops"][-1]) ^ 1)
    for door, token in (("wrong token", wrong), ("nearly right token", near), ("no token", None)):
        await attacker.knock(
            door, attacker.client(token, good), lambda c: c.list_sessions(),
            code="UNAUTHENTICATED", counter="refused UNAUTHENTICATED",
        )  # fmt: skip
    stranger = Authority(attacker.authority.ca.parent / "stranger")
    untrusted = dataclasses.replace(stranger.client("robot"), ca=attacker.authority.ca)
    papers = {
        "expired certificate": (
            attacker.authority.client("late", expired=True),
            "CERTIFICATE_EXPIRED",
        ),
        "certificate of a stranger": (untrusted, "CERTIFICATE_NOT_TRUSTED"),
        "no certificate": (attacker.authority.client(), "NO_CERTIFICATE"),
        "plaintext": (ClientCredentials(insecure=True), "PLAINTEXT"),
    }
    host = other_address() or "127.0.0.1"
    port = attacker.address.rpartition(":")[2]
    for door, (credentials, reason) in papers.items():
        address = f"{host}:{port}" if door == "plaintext" else None
        await attacker.knock(
            door, attacker.client(secrets["ops"], credentials, address),
            lambda c: c.list_sessions(), code="UNAVAILABLE", counter=f"handshake {reason}",
        )  # fmt: skip


async def attack_scopes(attacker: Attacker, secrets: dict[str, str]) -> None:
    """A known caller reaches for what is not its own."""
    good = attacker.authority.client("robot")
    theirs = encode_submap(make_submap(agent=1), request_id="stolen")
    elsewhere = encode_submap(make_submap("other"), request_id="elsewhere")
    reaches: dict[str, tuple[str, Callable[[MagicClient], Awaitable[object]]]] = {
        "A submits as B": ("alice", lambda c: c.submit_encoded(theirs)),
        "A resumes an upload of B": (
            "alice", lambda c: c.resume_upload(theirs.header.name, "stolen")),
        "A finishes B": ("alice", lambda c: c.finish_agent("room", "agent_1")),
        "A registers B": (
            "alice",
            lambda c: c.register_agent("room", "agent_1", model_id=MODEL_ID, dimension=DIMENSION)),
        "A writes to another session": ("alice", lambda c: c.submit_encoded(elsewhere)),
        "A reads another session": ("alice", lambda c: c.get_corrected_poses("other")),
        "A deletes": ("alice", lambda c: c.delete_session("room", force=True)),
        "reader submits": (
            "viewer", lambda c: c.submit_encoded(encode_submap(make_submap(), request_id="r"))),
        "reader merges": ("viewer", lambda c: c.start_global_map("room")),
        "reader lists all sessions": ("viewer", lambda c: c.list_sessions()),
    }  # fmt: skip
    for door, (caller, attempt) in reaches.items():
        await attacker.knock(
            door, attacker.client(secrets[caller], good), attempt,
            code="PERMISSION_DENIED", counter="refused PERMISSION_DENIED",
        )  # fmt: skip


async def attack_content(attacker: Attacker, rng: random.Random, secrets: dict[str, str]) -> None:
    """A caller with every right sends what must not be believed."""
    good = attacker.authority.client("robot")
    width, height = rng.randint(3000, 6000), rng.randint(3000, 6000)
    bomb = with_colour(encode_submap(make_submap(), request_id="bomb"), bomb_png(width, height))
    request = bomb_request(width, height)
    huge = encode_submap(make_submap(), request_id="huge")
    huge.header.camera.width = huge.header.camera.height = 7000

    def ask(name: str) -> Callable[[MagicClient], Awaitable[object]]:
        message = session_pb.GetAgentRequest(name=name)
        return lambda c: c.idempotent(c.session_stub.GetAgent, message)

    sent: list[tuple[str, Callable[[MagicClient], Awaitable[object]]]] = [
        ("oversize image in a sub-map", lambda c: c.submit_encoded(bomb)),
        ("oversize camera in a sub-map", lambda c: c.submit_encoded(huge)),
        (
            "oversize image to localise",
            lambda c: c.idempotent(c.mapping_stub.Localize, request),
        ),
        *(("path trick", ask(name)) for name in NAMES),
    ]
    for door, attempt in sent:
        await attacker.knock(
            door, attacker.client(secrets["ops"], good), attempt,
            code="INVALID_ARGUMENT", counter="refused INVALID_INPUT",
        )  # fmt: skip


async def attack_plaintext(folder: Path, secrets: dict[str, str], base: ServerConfig) -> Attacker:
    """A server that takes plaintext, and a token that comes that way from another address."""
    host = other_address()
    config = dataclasses.replace(
        base,
        data_dir=folder / "plaintext",
        tls=TlsConfig(),
        listen=ListenConfig(host="0.0.0.0", port=0, insecure=True),
    )
    async with ServeProcess(config, folder) as server:
        port = server.ready["target"].rpartition(":")[2]
        attacker = Attacker(
            f"{host}:{port}", server.ready["metrics"], folder, Authority(folder / "unused")
        )
        if host is not None:
            client = attacker.client(secrets["ops"], ClientCredentials(insecure=True))
            await attacker.knock(
                "token in plaintext", client, lambda c: c.list_sessions(),
                code="UNAUTHENTICATED", counter="refused PLAINTEXT_REFUSED",
            )  # fmt: skip
    return attacker


async def refuses_to_start(folder: Path) -> bool:
    """Whether a plaintext server beyond loopback is refused unless it is asked for."""
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "magic_cli", "serve", "--host", "0.0.0.0", "--port", "0",
        "--data-dir", str(folder / "never"), cwd=REPOSITORY, stderr=asyncio.subprocess.DEVNULL,
    )  # fmt: skip
    return await asyncio.wait_for(process.wait(), 120) == 2 and not (folder / "never").exists()


def stored_files(folder: Path) -> set[str]:
    """Blobs and unfinished uploads in a store."""
    parts = ("blobs", "incoming", "uploads")
    found = (file for part in parts for file in (folder / part).rglob("*"))
    return {str(file.relative_to(folder)) for file in found if file.is_file()}


async def attack(folder: Path, *, runs: int, seed: int) -> dict:
    """Every attack, `runs` times; returns the figures."""
    rng = random.Random(seed)
    secrets = {name: rng.randbytes(24).hex() for name in ("alice", "viewer", "ops")}
    (folder / "tokens").write_text(
        f"alice agent:sessions/room/agents/agent_0 {secrets['alice']}\n"
        f"viewer reader:sessions/room {secrets['viewer']}\n"
        f"ops admin {secrets['ops']}\n"
    )
    authority = Authority(folder / "ca")
    base = ServerConfig(
        data_dir=folder / "data",
        listen=ListenConfig(host="0.0.0.0", port=0),
        tls=authority.server(mutual=True),
        access=AccessConfig(folder / "tokens"),
        metrics=MetricsConfig(port=0),
        jobs=JobConfig(workers=1),
    )
    async with ServeProcess(base, folder) as server:
        attacker = Attacker(server.ready["target"], server.ready["metrics"], folder, authority)
        owner = attacker.client(secrets["ops"], authority.client("robot"))
        for session, agent in (("room", "agent_0"), ("room", "agent_1"), ("other", "agent_0")):
            await owner.register_agent(session, agent, model_id=MODEL_ID, dimension=DIMENSION)
        before = stored_files(base.data_dir)
        for _ in range(runs):
            await attack_identity(attacker, rng, secrets)
            await attack_scopes(attacker, secrets)
            await attack_content(attacker, rng, secrets)
        stored = len(await owner.list_submaps("room")) + len(await owner.list_submaps("other"))
        await owner.close()
        left = stored_files(base.data_dir) - before
    doors = attacker.doors | (await attack_plaintext(folder, secrets, base)).doors
    doors_open = sorted(name for name, door in doors.items() if not door.shut)
    return {
        "runs": runs,
        "attempts": sum(door.attempts for door in doors.values()),
        "refused": sum(door.refused for door in doors.values()),
        "counted": sum(door.counted for door in doors.values()),
        "stored": stored,
        "files_left": len(left),
        "refuses_plaintext_bind": await refuses_to_start(folder),
        "open": doors_open,
        "doors": {name: dataclasses.asdict(door) for name, door in doors.items()},
    }


def main() -> int:
    """Run the attacks; 0 when every door was shut."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="magic-access-") as folder:
        figures = asyncio.run(attack(Path(folder), runs=options.runs, seed=options.seed))
    if options.json:
        print(json.dumps(figures))
    else:
        for name, door in figures["doors"].items():
            codes = ", ".join(door["answers"])
            print(f"{name:32} {door['refused']}/{door['attempts']} {codes}, {door['counter']}")
        print({key: value for key, value in figures.items() if key != "doors"})
    shut = not figures["open"] and not figures["stored"] and not figures["files_left"]
    return 0 if shut and figures["refuses_plaintext_bind"] else 1


if __name__ == "__main__":
    sys.exit(main())
