"""The engine that a configuration asks for. A further one is added here and nowhere else."""

from __future__ import annotations

from pathlib import Path

from magic_core.tracing import TracingConfig
from magic_server.jobs.config import JobConfig
from magic_server.jobs.executor import ProcessExecutor
from magic_server.jobs.protocol import JobExecutor, JobObserver
from magic_server.store.bucket_client import BucketPlace


def new_executor(
    config: JobConfig,
    *,
    folder: Path,
    trace: TracingConfig,
    observer: JobObserver,
    bucket: BucketPlace | None = None,
) -> JobExecutor:
    """An engine that is not started yet; `folder` is the server's data folder, `bucket` where its
    blobs are, None where they are in that folder.

    Raises ConfigError when the engine is not installed.
    """
    if config.executor == "dask":
        from magic_server.jobs.cluster.executor import DaskExecutor

        return DaskExecutor(config, folder=folder, bucket=bucket, observer=observer)
    return ProcessExecutor(config, trace=trace, observer=observer)
