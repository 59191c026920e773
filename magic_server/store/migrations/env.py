"""What Alembic runs to go from revision to revision, within a transaction that is begun."""

from __future__ import annotations

from alembic import context

from magic_server.store import schema

context.configure(
    connection=context.config.attributes["connection"],
    target_metadata=schema.metadata,
    render_as_batch=True,  # SQLite cannot change a column in place
)
context.run_migrations()
