"""Registration of two sub-maps' views from nothing, and its verification."""

from magic_server.registration.config import RegistrationConfig
from magic_server.registration.register import RegistrationResult, register
from magic_server.registration.view import AnchorView, PreparedView, prepare

__all__ = [
    "AnchorView",
    "PreparedView",
    "RegistrationConfig",
    "RegistrationResult",
    "prepare",
    "register",
]
