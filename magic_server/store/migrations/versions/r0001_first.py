"""The tables as they were before revisions were counted: nothing to do, databases are at it."""

from __future__ import annotations

revision = "0001"
down_revision = None


def upgrade() -> None:
    """Databases that were begun without revisions have these tables."""
