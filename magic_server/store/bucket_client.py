"""Requests to one S3 bucket through s3fs: bounded, counted, and with errors that say what helps.

Credentials come from where AWS tools look for them: the environment, ~/.aws, or the role of the
machine. They are never part of a setting, a message or a log line.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import logging
import time
from collections.abc import Awaitable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from magic_core.errors import ConfigError, MagicError, NotFound, Unavailable
from magic_server.store.blob_store import BlobObserver

T = TypeVar("T")
RETRY_S = 1.0
"""How long callers are asked to wait while the bucket is away."""
AT_ONCE = 32
"""Requests of one call that are under way at a time."""
UPLOADS_AT_ONCE = 8
"""Of one process: each holds a blob, or four parts of it, in memory."""
CONNECT_S = 5.0
_LIBRARIES = ("aiobotocore", "botocore", "s3fs", "fsspec", "aiohttp")
_WRONG_KEYS = ("InvalidAccessKeyId", "SignatureDoesNotMatch", "ExpiredToken", "InvalidToken")
_ELSEWHERE = ("301", "307", "PermanentRedirect", "AuthorizationHeaderMalformed")


@dataclass(frozen=True, slots=True)
class BucketPlace:
    """Which bucket, and how it is spoken to. It goes to workers, and so holds no credentials."""

    bucket: str
    prefix: str
    """Beginning of all keys, without a slash at its end; empty for the whole bucket."""
    endpoint: str
    """URL of the S3 server; empty for AWS."""
    region: str
    part_bytes: int
    timeout_s: float
    cache: Path
    """Folder of what was read, on whichever machine reads."""
    cache_bytes: int

    def __str__(self) -> str:
        where = f" at {self.endpoint}" if self.endpoint else ""
        return f"s3://{self.path('').rstrip('/')}{where}"

    def path(self, key: str) -> str:
        """Bucket and key, as s3fs wants them."""
        return "/".join(part for part in (self.bucket, self.prefix, key) if part)

    def key(self, key: str) -> str:
        """A key within the bucket."""
        return f"{self.prefix}/{key}" if self.prefix else key


class BucketClient:
    """Makes requests; every method blocks."""

    def __init__(
        self, place: BucketPlace, *, observer: BlobObserver = lambda operation, outcome, s: None
    ) -> None:
        """ConfigError where s3fs is not installed, or the credentials' profile is not there."""
        self.place = place
        self._observer = observer
        self._uploads = asyncio.Semaphore(UPLOADS_AT_ONCE)
        self.files = _file_system(place)

    def run(self, operation: str, work: Awaitable[T]) -> T:
        """The result of one request; `operation` is what it is counted as."""
        return self.run_all(operation, [work])[0]

    def run_all(self, operation: str, works: Sequence[Awaitable[T]]) -> list[T]:
        """The results of several requests, some of them under way at a time."""
        from fsspec.asyn import sync

        if not works:
            return []
        with self.translated():
            done: Any = sync(self.files.loop, self._gather, operation, works)
            return done

    async def _gather(self, operation: str, works: Sequence[Awaitable[T]]) -> list[T]:
        places = self._uploads if operation == "put" else asyncio.Semaphore(AT_ONCE)

        async def one(work: Awaitable[T]) -> T:
            async with places:
                return await self._counted(operation, work)

        # All of them come to an end: none goes on behind an error that the caller acts on.
        found = await asyncio.gather(*map(one, works), return_exceptions=True)
        for result in found:
            if isinstance(result, BaseException):
                raise result
        return found  # pyright: ignore[reportReturnType]

    def observe(self, operation: str, outcome: str, seconds: float) -> None:
        """Count what was done without `run`."""
        self._observer(operation, outcome, seconds)

    async def _counted(self, operation: str, work: Awaitable[T]) -> T:
        begun = time.perf_counter()
        outcome = "failed"
        try:
            result = await work
            outcome = "ok"
            return result
        except FileNotFoundError:
            outcome = "missing"
            raise
        finally:
            self._observer(operation, outcome, time.perf_counter() - begun)

    def call(self, operation: str, method: str, **arguments: Any) -> dict[str, Any]:
        """One request of the S3 API as it is."""
        request = self.files._call_s3(method, Bucket=self.place.bucket, **arguments)
        return self.run(operation, request)

    @contextlib.contextmanager
    def translated(self) -> Iterator[None]:
        """Raise NotFound, or Unavailable with what helps, for whatever S3 and the way to it say."""
        try:
            yield
        except MagicError:
            raise
        except Exception as error:
            raise trouble(error, self.place) from _without_request(error)


def open_checked(client: BucketClient) -> None:
    """Look at the bucket for the first time: ConfigError for what the operator must change."""
    try:
        look(client)
    except Unavailable as error:
        if isinstance(error, BucketRefused):
            raise ConfigError.field("store.blobs", error.message) from error
        raise


def look(client: BucketClient) -> None:
    """Raise Unavailable unless the bucket answers and lets this process in."""
    client.call("list", "list_objects_v2", Prefix=client.place.key(""), MaxKeys=1)


class BucketRefused(Unavailable):
    """The S3 server answers, but not as it should: only its operator or ours can help."""


def code_of(error: BaseException) -> str:
    """The code of S3 behind an error of s3fs; empty where S3 did not answer."""
    for found in (error, error.__cause__):
        response = getattr(found, "response", None)
        if isinstance(response, dict):
            return str(response.get("Error", {}).get("Code", ""))
    return ""


def trouble(error: Exception, place: BucketPlace) -> MagicError:
    """What an error means to callers."""
    code, said = code_of(error), type(error).__name__
    if isinstance(error, FileNotFoundError) and code != "NoSuchBucket":
        return NotFound(f"a blob in {place} is missing; restore it from a backup")
    if remedy := _remedy(error, code, place):
        return BucketRefused(f"{place}: {code or said}; {remedy}", retry_after_s=RETRY_S)
    return Unavailable(
        f"the bucket {place} is away ({code or said}); does its S3 server run, and may this "
        "machine reach it?",
        retry_after_s=RETRY_S,
    )


def _remedy(error: Exception, code: str, place: BucketPlace) -> str:
    """What the operator must change; empty for what may pass by itself."""
    from botocore import exceptions

    credentials = (
        "give AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY in the environment, or AWS_PROFILE and "
        "~/.aws/credentials"
    )
    if code == "NoSuchBucket":
        return f"create the bucket {place.bucket}, or name another in store.blobs"
    if code in _WRONG_KEYS:
        return f"the credentials are wrong or have ended; {credentials}"
    if isinstance(
        error,
        exceptions.NoCredentialsError
        | exceptions.PartialCredentialsError
        | exceptions.CredentialRetrievalError
        | exceptions.ProfileNotFound,
    ):
        return f"no credentials were found; {credentials}"
    if isinstance(error, PermissionError):
        return (
            "check the credentials in the environment, and that they may list the bucket and read, "
            "write and delete below the prefix"
        )
    if code in _ELSEWHERE:
        return "the bucket is in another region; give store.s3_region"
    return ""


def _without_request(error: Exception) -> Exception | None:
    """The cause that may be logged: signed requests stay out of every log."""
    return None if code_of(error) else error


def _file_system(place: BucketPlace) -> Any:
    try:
        import s3fs
    except ModuleNotFoundError as error:
        raise ConfigError.field(
            "store.blobs",
            f"a bucket needs the package {error.name}: pip install 'magic-slam[cluster]'",
        ) from error
    for name in _LIBRARIES:  # at DEBUG they write down requests with their signatures
        logging.getLogger(name).setLevel(logging.WARNING)
    files = s3fs.S3FileSystem(
        endpoint_url=place.endpoint or None,
        client_kwargs={"region_name": place.region} if place.region else {},
        config_kwargs={
            "connect_timeout": min(CONNECT_S, place.timeout_s),
            "read_timeout": place.timeout_s,
            "retries": {"mode": "standard", "total_max_attempts": 2},
            "max_pool_connections": 2 * AT_ONCE,
            # Only what every S3 server understands; each request's body is signed with its SHA-256.
            "request_checksum_calculation": "when_required",
            "response_checksum_validation": "when_required",
            "s3": {
                "addressing_style": "path" if place.endpoint else "auto",
                "payload_signing_enabled": True,
            },
        },
        use_listings_cache=False,
        skip_instance_cache=True,
        max_concurrency=4,
    )
    files.retries = 2
    return files


@functools.lru_cache(maxsize=8)
def client_of(place: BucketPlace) -> BucketClient:
    """The client of a job's process: connections are kept from one job to the next."""
    return BucketClient(place)
