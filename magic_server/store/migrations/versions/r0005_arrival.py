"""Sub-maps and loops of a session are read page by page in the order of arrival."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0005"
down_revision = "0004"


def upgrade() -> None:
    """An index of both, in place of that of the session alone."""
    found = sa.inspect(op.get_bind())
    for table in ("submaps", "loops"):
        if not found.has_table(table):
            continue  # a damaged database: it is named afterwards
        indexes = {index["name"] for index in found.get_indexes(table)}
        if f"ix_{table}_arrival" not in indexes:
            op.create_index(f"ix_{table}_arrival", table, ["session_id", "id"])
        if f"ix_{table}_session_id" in indexes:
            op.drop_index(f"ix_{table}_session_id", table)
