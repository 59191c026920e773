"""A real S3 server for tests: moto's, over HTTP, which can be stopped and started again."""

from __future__ import annotations

import contextlib
import logging
import random
import socket
import urllib.request
import uuid
from collections.abc import Iterator
from typing import Any

import pytest

from magic_server.store_config import StoreConfig

KEY, SECRET = "magic-test-key", "not-in-any-log-either"
ENVIRONMENT = {
    "AWS_ACCESS_KEY_ID": KEY,
    "AWS_SECRET_ACCESS_KEY": SECRET,
    "AWS_DEFAULT_REGION": "us-east-1",
    # Nobody asks the network for credentials.
    "AWS_EC2_METADATA_DISABLED": "true",
    "AWS_CONFIG_FILE": "/nowhere",
    "AWS_SHARED_CREDENTIALS_FILE": "/nowhere",
}


class BucketServer:
    """An S3 server on a port of its own; its buckets stay while it is stopped."""

    key, secret = KEY, SECRET

    def __init__(self) -> None:
        self.port = free_port()
        self.endpoint = f"http://127.0.0.1:{self.port}"
        self._server: Any = None
        self._files: Any = None

    def start(self) -> None:
        """Begin to serve; waits until it does."""
        from moto.server import ThreadedMotoServer  # half a second of imports

        logging.getLogger("werkzeug").setLevel(logging.ERROR)
        self._server = ThreadedMotoServer("127.0.0.1", self.port, verbose=False)
        self._server.start()

    def stop(self) -> None:
        """Nobody listens on its port any more."""
        if self._server is not None:
            self._server.stop()
            self._server = None

    @contextlib.contextmanager
    def away(self) -> Iterator[None]:
        """Nobody listens on its port for a block."""
        self.stop()
        try:
            yield
        finally:
            self.start()

    @contextlib.contextmanager
    def judging(self) -> Iterator[None]:
        """Credentials are judged for a block: it knows none, so that all are wrong."""
        self._judge(b"0")
        try:
            yield
        finally:
            self._judge(b"1000000000")

    def _judge(self, allowed: bytes) -> None:
        asked = urllib.request.Request(
            f"{self.endpoint}/moto-api/reset-auth", allowed, {"Content-Type": "text/plain"}
        )
        with urllib.request.urlopen(asked):
            pass

    def files(self) -> Any:
        """A file system of its buckets."""
        import s3fs

        if self._files is None:
            self._files = s3fs.S3FileSystem(
                key=self.key,
                secret=self.secret,
                endpoint_url=self.endpoint,
                use_listings_cache=False,
                skip_instance_cache=True,
            )
        return self._files

    def bucket(self) -> str:
        """The name of a new, empty bucket."""
        name = f"test-{uuid.uuid4().hex[:12]}"
        self.files().mkdir(name)
        return name

    def store(self, **settings: Any) -> StoreConfig:
        """Settings of a new, empty bucket with a prefix."""
        place = f"s3://{self.bucket()}/some/prefix"
        return StoreConfig(blobs=place, s3_endpoint=self.endpoint, **settings)


@contextlib.contextmanager
def bucket_server() -> Iterator[BucketServer]:
    """A server for a block, and the credentials of this process and those that it starts."""
    server = BucketServer()
    server.start()
    try:
        with pytest.MonkeyPatch.context() as patch:
            for name, value in ENVIRONMENT.items():
                patch.setenv(name, value)
            for name in ("AWS_PROFILE", "AWS_SESSION_TOKEN", "AWS_ENDPOINT_URL"):
                patch.delenv(name, raising=False)
            yield server
    finally:
        server.stop()


def free_port() -> int:
    """A TCP port that nobody listens on, and that the system gives to nobody who asks for any."""
    while True:
        port = random.SystemRandom().randrange(10_000, 30_000)
        with socket.socket() as probe:
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
            return port
