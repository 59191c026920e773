"""Tables of the store. Names of columns are the facts; everything binary is little-endian.

A change here needs a revision under `migrations/versions`, for both engines.
"""

from __future__ import annotations

import sqlalchemy as sa

metadata = sa.MetaData()

# SQLite's integers have 64 bits under any name, and only INTEGER counts up by itself there.
INTEGER = sa.BigInteger().with_variant(sa.Integer(), "sqlite")

# What builds from before the revisions look at; it stays 1 for as long as they can use the tables.
SCHEMA_VERSION = 1
schema_version = sa.Table("schema_version", metadata, sa.Column("version", sa.Integer))

sessions = sa.Table(
    "sessions",
    metadata,
    sa.Column("id", INTEGER, primary_key=True),
    sa.Column("name", sa.String(63), nullable=False, unique=True),
    sa.Column("created_at", sa.Float, nullable=False),  # seconds since 1970, UTC
    sa.Column("model_id", sa.String(128), nullable=False),
    sa.Column("dimension", INTEGER, nullable=False),
    sqlite_autoincrement=True,  # what was deleted is never mistaken for what came after it
)

agents = sa.Table(
    "agents",
    metadata,
    sa.Column("id", INTEGER, primary_key=True),
    sa.Column("session_id", sa.ForeignKey("sessions.id"), nullable=False),
    sa.Column("name", sa.String(63), nullable=False),
    sa.Column("finished", sa.Boolean, nullable=False),
    sa.Column("registered_at", sa.Float, nullable=False),
    sa.Column("last_seen_at", sa.Float, nullable=False),
    sa.UniqueConstraint("session_id", "name"),
    sqlite_autoincrement=True,
)

submaps = sa.Table(
    "submaps",
    metadata,
    sa.Column("id", INTEGER, primary_key=True),  # grows with the order of arrival
    sa.Column("session_id", sa.ForeignKey("sessions.id"), nullable=False),
    sa.Column("agent_id", sa.ForeignKey("agents.id"), nullable=False),
    sa.Column("number", INTEGER, nullable=False),  # index within the agent
    sa.Column("request_id", sa.String(128), nullable=False),
    sa.Column("header_sha256", sa.LargeBinary(32), nullable=False),
    sa.Column("header", sa.LargeBinary, nullable=False),  # magicslam.v1.SubmapHeader
    sa.Column("received_at", sa.Float, nullable=False),
    sa.Column("first_timestamp_s", sa.Float, nullable=False),
    sa.Column("last_timestamp_s", sa.Float, nullable=False),
    sa.Column("frame_count", INTEGER, nullable=False),
    sa.Column("keyframe_count", INTEGER, nullable=False),
    sa.Column("gaussian_count", INTEGER, nullable=False),
    sa.Column("stored_bytes", INTEGER, nullable=False),
    # What the index and the pose graph need, so that a restart parses no header.
    sa.Column("descriptor", sa.LargeBinary, nullable=False),  # float32 (d,)
    # Of each keyframe that has one: uint32 place in the header, float32 (d,). NULL for none.
    sa.Column("keyframe_descriptors", sa.LargeBinary),
    sa.Column("previous_number", INTEGER),
    sa.Column("previous_from_anchor", sa.LargeBinary),  # float64 (4, 4)
    sa.Column("information", sa.LargeBinary),  # float64 (6, 6)
    sa.Column("prior", sa.LargeBinary),  # float64 (4, 4)
    sa.Column("searched", sa.Boolean, nullable=False),  # loop candidates were looked for
    sa.UniqueConstraint("agent_id", "number"),
    # Pages in the order of arrival: with the session alone PostgreSQL may sort all of it for each.
    sa.Index("ix_submaps_arrival", "session_id", "id"),
    sqlite_autoincrement=True,
)

# What is still known of a deleted sub-map: its number is not used again, a repeated upload gets its
# first answer, and its odometry joins the sub-maps before and behind it.
removed_submaps = sa.Table(
    "removed_submaps",
    metadata,
    sa.Column("agent_id", sa.ForeignKey("agents.id"), primary_key=True),
    sa.Column("number", INTEGER, primary_key=True),
    sa.Column("session_id", sa.ForeignKey("sessions.id"), nullable=False, index=True),
    sa.Column("request_id", sa.String(128), nullable=False),
    sa.Column("header_sha256", sa.LargeBinary(32), nullable=False),
    sa.Column("received_at", sa.Float, nullable=False),
    sa.Column("stored_bytes", INTEGER, nullable=False),
    sa.Column("previous_number", INTEGER),
    sa.Column("previous_from_anchor", sa.LargeBinary),  # float64 (4, 4)
    sa.Column("information", sa.LargeBinary),  # float64 (6, 6)
    sa.Column("prior", sa.LargeBinary),  # float64 (4, 4)
)

# First answers of deletions, so that a repeat gets the same. Rows older than a month are dropped.
deletions = sa.Table(
    "deletions",
    metadata,
    sa.Column("name", sa.String, primary_key=True),  # resource name
    sa.Column("request_id", sa.String(128), primary_key=True),
    sa.Column("submap_count", INTEGER, nullable=False),
    sa.Column("freed_bytes", INTEGER, nullable=False),
    sa.Column("deleted_at", sa.Float, nullable=False),
)

# First answers of imports (imports.py). They outlive the session: a late repeat must not bring a
# deleted one back.
imports = sa.Table(
    "imports",
    metadata,
    sa.Column("name", sa.String, primary_key=True),  # resource name of the session
    sa.Column("request_id", sa.String(128), primary_key=True),
    sa.Column("archive_sha256", sa.LargeBinary(32), nullable=False),  # of its manifest
    sa.Column("answer", sa.LargeBinary, nullable=False),  # magicslam.v1.Session
    sa.Column("imported_at", sa.Float, nullable=False),
)

# First answers of RegisterAgent and FinishAgent (answers.py).
answers = sa.Table(
    "answers",
    metadata,
    sa.Column("id", INTEGER, primary_key=True),
    sa.Column("agent_id", sa.ForeignKey("agents.id"), nullable=False),
    sa.Column("request_id", sa.String(128), nullable=False),
    sa.Column("request_sha256", sa.LargeBinary(32), nullable=False),
    sa.Column("answer", sa.String, nullable=False),  # JSON
    sa.Column("answered_at", sa.Float, nullable=False),
    sa.UniqueConstraint("agent_id", "request_id"),
)

submap_blobs = sa.Table(
    "submap_blobs",
    metadata,
    sa.Column("submap_id", sa.ForeignKey("submaps.id"), primary_key=True),
    sa.Column("position", INTEGER, primary_key=True),  # index in the header
    sa.Column("sha256", sa.String(64), nullable=False, index=True),
)

loops = sa.Table(
    "loops",
    metadata,
    sa.Column("id", INTEGER, primary_key=True),
    sa.Column("session_id", sa.ForeignKey("sessions.id"), nullable=False),
    sa.Column("source", sa.String, nullable=False),  # resource names
    sa.Column("target", sa.String, nullable=False),
    sa.Column("similarity", sa.Float, nullable=False),
    sa.Column("verdict", sa.String(16), nullable=False),
    sa.Column("reason", sa.String(64), nullable=False),
    sa.Column("target_from_source", sa.LargeBinary),  # float64 (4, 4)
    sa.Column("information", sa.LargeBinary),  # float64 (6, 6)
    sa.Column("fitness", sa.Float, nullable=False, default=0.0),
    sa.Column("rmse_m", sa.Float, nullable=False, default=0.0),
    sa.Column("inliers", INTEGER, nullable=False, default=0),
    sa.Column("overlap", sa.Float, nullable=False, default=0.0),
    sa.Column("verify_seconds", sa.Float, nullable=False, default=0.0),
    sa.Column("kept", sa.Boolean, nullable=False, default=False),
    # Places in the headers of the keyframes that look alike.
    sa.Column("source_keyframe", INTEGER, nullable=False, server_default="0"),
    sa.Column("target_keyframe", INTEGER, nullable=False, server_default="0"),
    sa.UniqueConstraint("session_id", "source", "target"),
    sa.Index("ix_loops_arrival", "session_id", "id"),
)

snapshots = sa.Table(
    "snapshots",
    metadata,
    sa.Column("session_id", sa.ForeignKey("sessions.id"), primary_key=True),
    sa.Column("revision", INTEGER, nullable=False),  # with the changes since
    sa.Column("snapshot", sa.LargeBinary, nullable=False),  # magicslam.v1.PoseSnapshot
    # Whether a solve of the whole graph stands behind it and the changes since.
    sa.Column("settled", sa.Boolean, nullable=False, default=False),
)

# Revisions since the stored solution, each with the poses that it changed.
snapshot_changes = sa.Table(
    "snapshot_changes",
    metadata,
    sa.Column("session_id", sa.ForeignKey("sessions.id"), primary_key=True),
    sa.Column("revision", INTEGER, primary_key=True),
    sa.Column("change", sa.LargeBinary, nullable=False),  # magicslam.v1.PoseSnapshot
)

operations = sa.Table(
    "operations",
    metadata,
    sa.Column("id", INTEGER, primary_key=True),
    sa.Column("session_id", sa.ForeignKey("sessions.id"), nullable=False),
    sa.Column("request_id", sa.String(128), nullable=False),
    sa.Column("request", sa.LargeBinary, nullable=False),  # magicslam.v1.BuildGlobalMapRequest
    sa.Column("state", sa.String(16), nullable=False),
    sa.Column("progress", sa.Float, nullable=False),
    sa.Column("stage", sa.String, nullable=False),
    sa.Column("created_at", sa.Float, nullable=False),
    sa.Column("updated_at", sa.Float, nullable=False),
    sa.Column("error_code", sa.String(32)),
    sa.Column("error_reason", sa.String(64)),
    sa.Column("error_message", sa.String),
    sa.Column("map_id", sa.ForeignKey("maps.id")),
    sa.UniqueConstraint("session_id", "request_id"),
)

maps = sa.Table(
    "maps",
    metadata,
    sa.Column("id", INTEGER, primary_key=True),
    sa.Column("session_id", sa.ForeignKey("sessions.id"), nullable=False, index=True),
    sa.Column("component", sa.String, nullable=False),
    sa.Column("revision", INTEGER, nullable=False),
    sa.Column("submaps", sa.JSON, nullable=False),  # resource names
    sa.Column("gaussian_count", INTEGER, nullable=False),
    sa.Column("created_at", sa.Float, nullable=False),
)

map_files = sa.Table(
    "map_files",
    metadata,
    sa.Column("map_id", sa.ForeignKey("maps.id"), primary_key=True),
    sa.Column("format", sa.String(16), primary_key=True),  # ply, lossless, compact
    sa.Column("sha256", sa.String(64), nullable=False, index=True),
    sa.Column("length", INTEGER, nullable=False),
)

# Which server works on a session when several share the database (leases.py).
leases = sa.Table(
    "leases",
    metadata,
    sa.Column("session_id", sa.ForeignKey("sessions.id"), primary_key=True),
    sa.Column("holder", sa.String(64), nullable=False),  # one run of one server
    sa.Column("address", sa.String(255), nullable=False),  # where clients reach it
    sa.Column("token", INTEGER, nullable=False),  # counts up with every change of the holder
    sa.Column("expires_at", sa.Float, nullable=False),  # by the database's clock
)

# One row: which store this is, so that a blob folder is not used with another database.
identity = sa.Table(
    "identity",
    metadata,
    sa.Column("id", sa.String(32), primary_key=True),
)
