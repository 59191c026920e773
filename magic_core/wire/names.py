"""Resource names: `sessions/{s}/agents/{a}/submaps/{m}` and their kin.

An id is a letter or digit, then letters, digits, '.', '_' or '-', at most 63 characters: safe as a
file name, in a URL and in a log.
"""

from __future__ import annotations

import re

from magic_core.errors import InvalidInput

_ID = r"[A-Za-z0-9][A-Za-z0-9._-]{0,62}"
_INDEX = r"0|[1-9][0-9]{0,8}"
_RULE = "ids are a letter or digit, then letters, digits, '.', '_' or '-', at most 63 characters"


def session_name(session: str) -> str:
    """The resource name of a session id."""
    return f"sessions/{session}"


def agent_name(session: str, agent: str) -> str:
    """The resource name of an agent."""
    return f"sessions/{session}/agents/{agent}"


def submap_name(session: str, agent: str, index: int) -> str:
    """The resource name of a sub-map."""
    return f"sessions/{session}/agents/{agent}/submaps/{index}"


def operation_name(session: str, operation: str) -> str:
    """The resource name of an operation."""
    return f"sessions/{session}/operations/{operation}"


def map_name(session: str, map_id: str) -> str:
    """The resource name of a global map."""
    return f"sessions/{session}/maps/{map_id}"


def parse_session(name: str, *, field: str = "name") -> str:
    """The session id of `sessions/{s}`; InvalidInput naming the field otherwise."""
    return _parse(_SESSION, name, "sessions/{session}", field)[0]


def parse_agent(name: str, *, field: str = "name") -> tuple[str, str]:
    """(session, agent) of `sessions/{s}/agents/{a}`."""
    session, agent = _parse(_AGENT, name, "sessions/{session}/agents/{agent}", field)
    return session, agent


def parse_submap(name: str, *, field: str = "name") -> tuple[str, str, int]:
    """(session, agent, index) of `sessions/{s}/agents/{a}/submaps/{m}`."""
    shape = "sessions/{session}/agents/{agent}/submaps/{index}"
    session, agent, index = _parse(_SUBMAP, name, shape, field)
    return session, agent, int(index)


def parse_operation(name: str, *, field: str = "name") -> tuple[str, str]:
    """(session, operation) of `sessions/{s}/operations/{o}`."""
    session, operation = _parse(_OPERATION, name, "sessions/{session}/operations/{id}", field)
    return session, operation


def parse_map(name: str, *, field: str = "name") -> tuple[str, str]:
    """(session, map) of `sessions/{s}/maps/{m}`."""
    session, map_id = _parse(_MAP, name, "sessions/{session}/maps/{id}", field)
    return session, map_id


def session_of(name: str) -> str:
    """The session id of any name that begins with `sessions/{s}/` or is `sessions/{s}`."""
    return parse_session("/".join(name.split("/")[:2]))


def _parse(pattern: re.Pattern[str], name: str, shape: str, field: str) -> tuple[str, ...]:
    match = pattern.fullmatch(name)
    if match is None:
        shown = name if len(name) <= 200 else name[:200] + "..."
        raise InvalidInput.field(field, f"{shown!r} is not of the form {shape}; {_RULE}")
    return match.groups()


_SESSION = re.compile(rf"sessions/({_ID})")
_AGENT = re.compile(rf"sessions/({_ID})/agents/({_ID})")
_SUBMAP = re.compile(rf"sessions/({_ID})/agents/({_ID})/submaps/({_INDEX})")
_OPERATION = re.compile(rf"sessions/({_ID})/operations/({_ID})")
_MAP = re.compile(rf"sessions/({_ID})/maps/({_ID})")
