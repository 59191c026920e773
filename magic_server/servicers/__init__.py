"""The services: thin layers that convert, call and convert back."""

from magic_server.servicers.global_maps import GlobalMapServicer
from magic_server.servicers.mapping import MappingServicer
from magic_server.servicers.sessions import SessionServicer

__all__ = ["GlobalMapServicer", "MappingServicer", "SessionServicer"]
