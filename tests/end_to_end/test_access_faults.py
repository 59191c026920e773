"""Every door of a real server that should be shut is shut, and counted."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.faults.access import attack


@pytest.mark.slow
async def test_every_attack_is_refused_with_its_code_and_counted(tmp_path: Path) -> None:
    figures = await attack(tmp_path, runs=1, seed=7)
    assert figures["open"] == []
    assert figures["attempts"] == figures["refused"] == figures["counted"] > 25
    assert (figures["stored"], figures["files_left"]) == (0, 0)
    assert figures["refuses_plaintext_bind"]
