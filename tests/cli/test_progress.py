"""Progress of a run: bars on a terminal, plain lines in a log."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from magic_cli import progress as module
from magic_cli.agent import status_line
from magic_cli.progress import RunProgress
from tests.core.small_flat import small_flat


@pytest.fixture
def printed(monkeypatch):
    def use(*, terminal):
        stream = io.StringIO()
        shown = Console(file=stream, force_terminal=terminal, width=120, highlight=False)
        monkeypatch.setattr(module, "console", shown)
        return stream

    return use


def walk(progress):
    for frames in (6, 12, 18):
        progress.agent("agent_0", {"frames": frames, "submaps": frames // 6, "revision": 2})
    progress.merge(0.1, "appending")
    progress.merge(0.5, "refining")
    progress.merge(0.9, "refining")
    progress.agent_ended("agent_0", "completed")


def test_a_log_gets_plain_lines_with_rate_and_remaining_time(printed, monkeypatch):
    monkeypatch.setattr(module, "PLAIN_INTERVAL_S", -1.0)
    stream = printed(terminal=False)
    with RunProgress(list(small_flat()[:2])) as progress:
        walk(progress)
    text = stream.getvalue()
    assert "\x1b" not in text
    assert "frames: agent_0 6/24, agent_1 0/24" in text
    assert "frames/s" in text
    assert "left" in text
    assert text.count("map: refining") == 1  # a stage is said once, not at every step
    assert "agent_0: completed after 18 frames" in text


def test_lines_in_a_log_are_seldom(printed):
    stream = printed(terminal=False)
    with RunProgress(list(small_flat()[:1])) as progress:
        for frames in range(24):
            progress.agent("agent_0", {"frames": frames})
    assert stream.getvalue() == ""


def test_a_terminal_gets_bars(printed):
    stream = printed(terminal=True)
    with RunProgress(list(small_flat()[:1])) as progress:
        walk(progress)
    text = stream.getvalue()
    assert "\x1b" in text
    for part in ("agent_0", "18/24", "3 sub-maps", "map"):
        assert part in text


def test_an_agent_on_a_camera_says_live_instead_of_a_length():
    figures = {"frames": 12, "dropped": 1, "lost": 0, "submaps": 2, "revision": 4}
    assert status_line(figures | {"of": None}).startswith("frame 12, live, 1 dropped, 0 lost")
    assert status_line(figures | {"of": 90}).startswith("frame 12/90, 1 dropped")
