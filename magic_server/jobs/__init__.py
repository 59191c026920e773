"""Heavy work: where it runs and what it is."""

from magic_server.jobs.config import JobConfig
from magic_server.jobs.engines import new_executor
from magic_server.jobs.executor import ProcessExecutor
from magic_server.jobs.protocol import JobExecutor

__all__ = ["JobConfig", "JobExecutor", "ProcessExecutor", "new_executor"]
