"""First answers of imports; and what databases of the first builds lack of revision 0001.

Those builds added tables without counting revisions, so 0001 stands for several states. There the
ids of deleted rows may be given again: SQLite adds AUTOINCREMENT to no table that exists.
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"

_INTEGER = sa.BigInteger().with_variant(sa.Integer(), "sqlite")


def upgrade() -> None:
    """One new table, and those that are missing."""
    op.create_table(
        "imports",
        sa.Column("name", sa.String(), primary_key=True),
        sa.Column("request_id", sa.String(128), primary_key=True),
        sa.Column("archive_sha256", sa.LargeBinary(32), nullable=False),
        sa.Column("answer", sa.LargeBinary(), nullable=False),
        sa.Column("imported_at", sa.Float(), nullable=False),
    )
    found = sa.inspect(op.get_bind())
    for table, columns in _missing_from_first_builds().items():
        if not found.has_table(table):
            op.create_table(table, *columns)
    columns = found.get_columns("snapshots") if found.has_table("snapshots") else []
    if columns and "settled" not in {column["name"] for column in columns}:
        # Not settled: the graph is solved once more at the next start.
        settled = sa.Column("settled", sa.Boolean(), nullable=False, server_default=sa.false())
        op.add_column("snapshots", settled)


def _missing_from_first_builds() -> dict[str, list[sa.Column | sa.UniqueConstraint]]:
    return {
        "removed_submaps": [
            sa.Column("agent_id", _INTEGER, sa.ForeignKey("agents.id"), primary_key=True),
            sa.Column("number", _INTEGER, primary_key=True),
            sa.Column(
                "session_id", _INTEGER, sa.ForeignKey("sessions.id"), nullable=False, index=True
            ),
            sa.Column("request_id", sa.String(128), nullable=False),
            sa.Column("header_sha256", sa.LargeBinary(32), nullable=False),
            sa.Column("received_at", sa.Float(), nullable=False),
            sa.Column("stored_bytes", _INTEGER, nullable=False),
            sa.Column("previous_number", _INTEGER),
            sa.Column("previous_from_anchor", sa.LargeBinary()),
            sa.Column("information", sa.LargeBinary()),
            sa.Column("prior", sa.LargeBinary()),
        ],
        "deletions": [
            sa.Column("name", sa.String(), primary_key=True),
            sa.Column("request_id", sa.String(128), primary_key=True),
            sa.Column("submap_count", _INTEGER, nullable=False),
            sa.Column("freed_bytes", _INTEGER, nullable=False),
            sa.Column("deleted_at", sa.Float(), nullable=False),
        ],
        "answers": [
            sa.Column("id", _INTEGER, primary_key=True),
            sa.Column("agent_id", _INTEGER, sa.ForeignKey("agents.id"), nullable=False),
            sa.Column("request_id", sa.String(128), nullable=False),
            sa.Column("request_sha256", sa.LargeBinary(32), nullable=False),
            sa.Column("answer", sa.String(), nullable=False),
            sa.Column("answered_at", sa.Float(), nullable=False),
            sa.UniqueConstraint("agent_id", "request_id"),
        ],
        "snapshot_changes": [
            sa.Column("session_id", _INTEGER, sa.ForeignKey("sessions.id"), primary_key=True),
            sa.Column("revision", _INTEGER, primary_key=True),
            sa.Column("change", sa.LargeBinary(), nullable=False),
        ],
    }
