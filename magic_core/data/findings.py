"""What a check of a dataset found."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from magic_core.errors import DataError

Status = Literal["ok", "warn", "fail"]


@dataclass(frozen=True, slots=True)
class Finding:
    """The outcome of one check."""

    name: str
    """What was checked, with the agent where there are several."""
    status: Status
    detail: str
    """What was found."""
    remedy: str = ""
    """What to do about it; empty when all is well."""

    @classmethod
    def failed(cls, name: str, error: DataError) -> Finding:
        """A failure from an error, whose message is `what is wrong; what to do`."""
        found, _, remedy = error.message.partition("; ")
        return cls(name, "fail", found, remedy)


@dataclass(frozen=True, slots=True)
class DatasetReport:
    """Everything that was found in a dataset."""

    path: Path
    findings: tuple[Finding, ...]

    @property
    def ok(self) -> bool:
        """Whether nothing failed; warnings do not count."""
        return all(finding.status != "fail" for finding in self.findings)
