"""Registration of two sub-maps' views from nothing, and its verification.

`magic_server.registration.register.register` does it. What computes is loaded on first use, so that
a server starts quickly and stays small.
"""

from typing import TYPE_CHECKING, Any

from magic_server.registration.config import RegistrationConfig

if TYPE_CHECKING:
    from magic_server.registration.view import AnchorView, PreparedView, prepare

__all__ = ["AnchorView", "PreparedView", "RegistrationConfig", "prepare"]


def __getattr__(name: str) -> Any:
    if name in ("AnchorView", "PreparedView", "prepare"):
        from magic_server.registration import view

        return getattr(view, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
