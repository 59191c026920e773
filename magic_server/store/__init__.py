"""What a server remembers: a database beside a content-addressed blob folder."""

from magic_server.store.agents import Registration, require_model
from magic_server.store.answers import Asked
from magic_server.store.archive import ImportedSubmap, archive_of
from magic_server.store.blob_store import BlobObserver, BlobStore, WrittenBlob
from magic_server.store.blobs import BlobFolder, BlobWriter
from magic_server.store.deletions import Deleted, DeletionRequest, NewSolution
from magic_server.store.imports import Imported, ImportRequest
from magic_server.store.leases import LeaseTable
from magic_server.store.maps import NewMap, OpenOperation
from magic_server.store.rows import (
    AgentRow,
    GraphVertex,
    MapFile,
    NewSubmap,
    RemovedSubmap,
    SessionRow,
    StoredSubmap,
    Vertex,
)
from magic_server.store.store import Store
from magic_server.store.submaps import FirstAnswer
from magic_server.store.uploads import PartialUpload, UploadFolder, UploadName

__all__ = [
    "AgentRow",
    "Asked",
    "BlobFolder",
    "BlobObserver",
    "BlobStore",
    "BlobWriter",
    "Deleted",
    "DeletionRequest",
    "FirstAnswer",
    "GraphVertex",
    "ImportRequest",
    "Imported",
    "ImportedSubmap",
    "LeaseTable",
    "MapFile",
    "NewMap",
    "NewSolution",
    "NewSubmap",
    "OpenOperation",
    "PartialUpload",
    "Registration",
    "RemovedSubmap",
    "SessionRow",
    "Store",
    "StoredSubmap",
    "UploadFolder",
    "UploadName",
    "Vertex",
    "WrittenBlob",
    "archive_of",
    "require_model",
]
