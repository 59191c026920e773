"""Heavy work: where it runs and what it is."""

from magic_server.jobs.executor import JobConfig, JobExecutor, ProcessExecutor

__all__ = ["JobConfig", "JobExecutor", "ProcessExecutor"]
