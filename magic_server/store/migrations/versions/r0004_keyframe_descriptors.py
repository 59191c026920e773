"""Descriptors of keyframes, and which keyframes of a loop look alike."""

from __future__ import annotations

import re

import sqlalchemy as sa
from alembic import op

revision = "0004"
down_revision = "0003"

_INTEGER = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
_PGVECTOR_TABLE = re.compile(r"descriptors_\d+")


def upgrade() -> None:
    """Three new columns; and where pgvector holds descriptors, several of one sub-map."""
    found = sa.inspect(op.get_bind())
    for table, column in (
        ("submaps", sa.Column("keyframe_descriptors", sa.LargeBinary())),
        ("loops", _keyframe("source_keyframe")),
        ("loops", _keyframe("target_keyframe")),
    ):
        # A damaged database may lack the table: it is named afterwards.
        names = {c["name"] for c in found.get_columns(table)} if found.has_table(table) else None
        if names is not None and column.name not in names:
            op.add_column(table, column)
    for table in filter(_PGVECTOR_TABLE.fullmatch, found.get_table_names()):
        key = found.get_pk_constraint(table)
        if "keyframe" not in key["constrained_columns"]:
            op.add_column(table, _keyframe("keyframe"))
            op.drop_constraint(str(key["name"]), table)
            op.create_primary_key(None, table, ["submap_id", "keyframe"])


def _keyframe(name: str) -> sa.Column:
    # A server of the build before, which knows no such column, may write for a while still.
    return sa.Column(name, _INTEGER, nullable=False, server_default="0")
