"""A session as one portable file: written, read and checked (docs/wire-format.md)."""

from magic_server.archive.transfer import Archives

__all__ = ["Archives"]
