"""Leases of sessions, and which store a database is."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"

_INTEGER = sa.BigInteger().with_variant(sa.Integer(), "sqlite")


def upgrade() -> None:
    """Two new tables."""
    op.create_table(
        "leases",
        sa.Column("session_id", _INTEGER, sa.ForeignKey("sessions.id"), primary_key=True),
        sa.Column("holder", sa.String(64), nullable=False),
        sa.Column("address", sa.String(255), nullable=False),
        sa.Column("token", _INTEGER, nullable=False),
        sa.Column("expires_at", sa.Float, nullable=False),
    )
    op.create_table("identity", sa.Column("id", sa.String(32), primary_key=True))
