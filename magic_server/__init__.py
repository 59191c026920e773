"""The server of magic-slam: places, loops, the pose graph, the global map, and the service."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from magic_server.config import ServerConfig
    from magic_server.server import Server, serve

__all__ = ["Server", "ServerConfig", "serve"]


def __getattr__(name: str) -> Any:
    # Workers import this package before their first job: the network is loaded on first use.
    if name == "ServerConfig":
        from magic_server.config import ServerConfig

        return ServerConfig
    if name in ("Server", "serve"):
        from magic_server import server

        return getattr(server, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
