"""Resource names: one form, safe everywhere."""

from __future__ import annotations

import pytest

from magic_core.errors import InvalidInput
from magic_core.wire import names


def test_names_parse_to_what_made_them() -> None:
    assert names.parse_session(names.session_name("kitchen")) == "kitchen"
    assert names.parse_agent(names.agent_name("kitchen", "a-1")) == ("kitchen", "a-1")
    assert names.parse_submap(names.submap_name("k", "a.b", 12)) == ("k", "a.b", 12)
    assert names.parse_operation(names.operation_name("k", "3")) == ("k", "3")
    assert names.parse_map(names.map_name("k", "3")) == ("k", "3")
    assert names.session_of("sessions/k/agents/a/submaps/0") == "k"


@pytest.mark.parametrize(
    "name",
    [
        "",
        "kitchen",
        "sessions/",
        "sessions/..",
        "sessions/.hidden",
        "sessions/a/b",
        "sessions/a b",
        "sessions/a\n",
        "sessions/a\0",
        "sessions/ä",
        "sessions/" + "a" * 64,
        "/sessions/a",
        "sessions/a/",
    ],
)
def test_other_session_names_are_refused(name: str) -> None:
    with pytest.raises(InvalidInput) as caught:
        names.parse_session(name, field="session")
    assert caught.value.violations[0].field == "session"


@pytest.mark.parametrize("index", ["-1", "01", "1e3", "9999999999", "", "0x1", "١"])
def test_other_submap_indices_are_refused(index: str) -> None:
    with pytest.raises(InvalidInput):
        names.parse_submap(f"sessions/a/agents/b/submaps/{index}")
