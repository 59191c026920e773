"""What a server remembers: SQLite beside a content-addressed blob folder."""

from magic_server.store.agents import require_model
from magic_server.store.blobs import BlobFolder, BlobWriter
from magic_server.store.deletions import Deleted, DeletionRequest, NewSolution
from magic_server.store.maps import NewMap, OpenOperation
from magic_server.store.rows import (
    AgentRow,
    MapFile,
    NewSubmap,
    RemovedSubmap,
    SessionRow,
    StoredSubmap,
    Vertex,
)
from magic_server.store.store import Store
from magic_server.store.submaps import FirstAnswer

__all__ = [
    "AgentRow",
    "BlobFolder",
    "BlobWriter",
    "Deleted",
    "DeletionRequest",
    "FirstAnswer",
    "MapFile",
    "NewMap",
    "NewSolution",
    "NewSubmap",
    "OpenOperation",
    "RemovedSubmap",
    "SessionRow",
    "Store",
    "StoredSubmap",
    "Vertex",
    "require_model",
]
