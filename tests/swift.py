"""OpenStack Swift with its S3 interface, from Debian's python3-swift: a second S3 server for tests.

Four processes of the system's Python: proxy, account, container and object server, one replica on
one device in a folder.
"""

from __future__ import annotations

import contextlib
import os
import pwd
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.bucket import ENVIRONMENT, BucketServer, free_port

PYTHON = "/usr/bin/python3"
START_S = 120.0
KEY, SECRET = "test:tester", "not-in-any-log-of-swift"
_RUN = """
import sys
import swift.common.utils as utils
folder, server = sys.argv[1:]
utils.SWIFT_CONF_FILE = folder + "/swift.conf"

class Cache(dict):  # in place of memcached: there is one proxy
    def __bool__(self):
        return True
    def set(self, key, value, **options):
        self[key] = value
    def get(self, key, **options):
        return super().get(key)
    def delete(self, key, **options):
        self.pop(key, None)
    def incr(self, key, delta=1, **options):
        self[key] = int(self.get(key) or 0) + delta
        return self[key]

def with_cache(settings, **others):
    cache = Cache()
    def wrapped(app):
        def called(environment, start):
            environment["swift.cache"] = cache
            return app(environment, start)
        return called
    return wrapped

sys.modules["test_cache"] = sys.modules["__main__"]
from swift.common.wsgi import run_wsgi
sys.exit(run_wsgi(f"{folder}/{server}-server.conf", f"{server}-server", verbose=True))
"""
_RINGS = """
import sys
from swift.common.ring import RingBuilder
folder, *ports = sys.argv[1:]
for name, port in zip(("account", "container", "object"), ports):
    ring = RingBuilder(4, 1, 0)
    ring.add_dev({"id": 0, "region": 1, "zone": 1, "ip": "127.0.0.1", "port": int(port),
                  "device": "d", "weight": 1.0})
    ring.rebalance()
    ring.get_ring().save(f"{folder}/{name}.ring.gz")
"""
_STORAGE = """
[DEFAULT]
bind_ip = 127.0.0.1
bind_port = {port}
user = {user}
swift_dir = {folder}
devices = {folder}/devices
mount_check = false
workers = 0
fallocate_reserve = 0
[pipeline:main]
pipeline = {server}-server
[app:{server}-server]
use = egg:swift#{server}
"""
_PROXY = """
[DEFAULT]
bind_ip = 127.0.0.1
bind_port = {port}
user = {user}
swift_dir = {folder}
workers = 0
[pipeline:main]
pipeline = catch_errors cache s3api tempauth copy slo dlo proxy-server
[app:proxy-server]
use = egg:swift#proxy
account_autocreate = true
[filter:catch_errors]
use = egg:swift#catch_errors
[filter:cache]
paste.filter_factory = test_cache:with_cache
[filter:s3api]
use = egg:swift#s3api
location = us-east-1
min_segment_size = 1048576
[filter:tempauth]
use = egg:swift#tempauth
user_{account}_{name} = {secret} .admin
[filter:copy]
use = egg:swift#copy
[filter:slo]
use = egg:swift#slo
minimum_segment_size = 1
[filter:dlo]
use = egg:swift#dlo
"""


class NoSwift(Exception):
    """Swift cannot be started here, and why."""


class SwiftServer(BucketServer):
    """A running Swift."""

    key, secret = KEY, SECRET

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self._folder = folder
        self._proxy: subprocess.Popen[bytes] | None = None
        self._others: list[subprocess.Popen[bytes]] = []

    def prepare(self) -> None:
        """Write the configuration, and start everything behind the proxy."""
        (self._folder / "devices" / "d").mkdir(parents=True)
        hashes = "swift_hash_path_prefix = test\nswift_hash_path_suffix = test\n"
        policies = "[storage-policy:0]\nname = one\ndefault = yes\n"
        (self._folder / "swift.conf").write_text(f"[swift-hash]\n{hashes}{policies}")
        servers = ("account", "container", "object")
        ports = {server: free_port() for server in servers}
        given = {"folder": self._folder, "user": pwd.getpwuid(os.geteuid()).pw_name}
        for server, port in ports.items():
            text = _STORAGE.format(server=server, port=port, **given)
            (self._folder / f"{server}-server.conf").write_text(text)
        account, _, name = KEY.partition(":")
        proxy = _PROXY.format(port=self.port, account=account, name=name, secret=SECRET, **given)
        (self._folder / "proxy-server.conf").write_text(proxy)
        rings = [PYTHON, "-c", _RINGS, str(self._folder), *map(str, ports.values())]
        done = subprocess.run(rings, capture_output=True, text=True, check=False, env=_bare())
        if done.returncode:
            raise NoSwift(f"apt-get install python3-swift: {done.stderr[-300:]}")
        self._others = [self._run(server) for server in servers]
        for port in ports.values():
            self._wait(port)

    def start(self) -> None:
        """Begin to serve; waits until it does."""
        self._proxy = self._run("proxy")
        self._wait(self.port)

    def stop(self) -> None:
        """Nobody listens on its port any more."""
        if self._proxy is not None:
            _end(self._proxy)
            self._proxy = None

    def close(self) -> None:
        """End everything."""
        self.stop()
        for process in self._others:
            _end(process)

    @contextlib.contextmanager
    def judging(self) -> Iterator[None]:
        """Credentials are wrong for a block."""
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("AWS_SECRET_ACCESS_KEY", f"not-{SECRET}")
            yield

    def _run(self, server: str) -> subprocess.Popen[bytes]:
        with (self._folder / "log").open("ab") as log:
            return subprocess.Popen(
                [PYTHON, "-c", _RUN, str(self._folder), server], stdin=subprocess.DEVNULL,
                stdout=log, stderr=log, start_new_session=True, env=_bare(),
            )  # fmt: skip

    def _wait(self, port: int) -> None:
        end = time.monotonic() + START_S
        while time.monotonic() < end:
            with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port)):
                return
            time.sleep(0.05)
        raise NoSwift((self._folder / "log").read_text()[-1000:])


@contextlib.contextmanager
def swift_server() -> Iterator[SwiftServer]:
    """A server for a block, and the credentials of this process; NoSwift where there is none."""
    folder = Path(tempfile.mkdtemp(prefix="magic-swift-"))  # a disk with extended attributes
    server = SwiftServer(folder)
    try:
        if not Path(PYTHON).exists():
            raise NoSwift(f"{PYTHON} is not there")
        server.prepare()
        server.start()
        with pytest.MonkeyPatch.context() as patch:
            own = {"AWS_ACCESS_KEY_ID": KEY, "AWS_SECRET_ACCESS_KEY": SECRET}
            for name, value in (ENVIRONMENT | own).items():
                patch.setenv(name, value)
            yield server
    finally:
        server.close()
        shutil.rmtree(folder, ignore_errors=True)


def _end(process: subprocess.Popen[bytes]) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def _bare() -> dict[str, str]:
    """An environment in which the system's Python finds its own packages alone."""
    return {"PATH": "/usr/bin:/bin", "HOME": "/tmp", "LANG": "C.UTF-8"}
