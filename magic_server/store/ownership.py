"""Whose a data folder is: one SQLite server's, or that of all servers of one database."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path

from magic_core.errors import WrongState

_ID_FILE = "database-id"
_SQLITE = "magic.sqlite"


def lock(folder: Path, *, shared: bool = False) -> int:
    """An open file that holds the folder's lock for as long as this process lives.

    WrongState when another server has it, or with `shared` when it is another kind of server.
    """
    descriptor = os.open(folder / "lock", os.O_RDWR | os.O_CREAT, 0o644)
    try:
        fcntl.flock(descriptor, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise WrongState(
            f"{folder} is in use by another server; stop it or choose another data folder"
        ) from None
    return descriptor


def require_own_database(folder: Path) -> None:
    """Raise WrongState where the blobs belong to a PostgreSQL database: SQLite knows none of them,
    and would remove them."""
    if (folder / _ID_FILE).exists():
        raise WrongState(
            f"{folder} holds the blobs of a PostgreSQL database; give store.database, or choose "
            "another data folder"
        )


def require_no_sqlite(folder: Path) -> None:
    """Raise WrongState where the folder has sessions that a PostgreSQL database does not know."""
    if (folder / _SQLITE).exists():
        raise WrongState(
            f"{folder} holds sessions in {_SQLITE}, which store.database does not know; move them "
            "with `magic sessions export` and `import`, and choose another data folder"
        )


def require_database(folder: Path, identity: str, *, is_new: bool) -> None:
    """Raise WrongState unless the folder's blobs are those of this database.

    `is_new`: the database was begun just now, and with it the folder.
    """
    require_no_sqlite(folder)
    file = folder / _ID_FILE
    if is_new and not file.exists():
        file.write_text(f"{identity}\n")
        return
    found = file.read_text().strip() if file.exists() else None
    if found != identity:
        theirs = "no database's" if found is None else f"those of database {found}"
        raise WrongState(
            f"{folder} is not the data folder of this database ({identity}): its blobs are "
            f"{theirs}; all servers of a database share one data folder, give its path"
        )
