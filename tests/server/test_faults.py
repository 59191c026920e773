"""Short campaigns of tests/faults; the long ones are run by hand (benchmarks/results/faults.md)."""

from __future__ import annotations

import pytest

from tests.faults import kill, network
from tests.faults.proxy import Weather
from tests.faults.recorded import large_recording, recording


async def test_kills_lose_nothing_that_was_acknowledged() -> None:
    figures = await kill.campaign(runs=3, seed=3, kills_per_store=3, submaps=3, loops=False)
    assert figures.good, figures
    assert figures.runs == 3
    assert figures.acknowledged == 12
    assert figures.cut_uploads > 0


async def test_connections_cut_at_any_byte_cost_time_alone() -> None:
    weathers = {"clear": Weather(), "cut": Weather(cut_after=(9_000, 90_000), cuts=6)}
    recorded = recording(agents=3, submaps=2)
    figures = await network.campaign(recorded, runs=2, seed=1, weathers=weathers)
    assert (figures.lost, figures.duplicated, figures.damaged) == (0, 0, 0)
    assert figures.acknowledged == 12
    assert figures.kinds["cut"].cuts == 6


@pytest.mark.slow
async def test_kills_with_loops_lose_nothing() -> None:
    figures = await kill.campaign(runs=20, seed=4, kills_per_store=20)
    assert figures.good, figures
    assert figures.resumed_uploads > 0


@pytest.mark.slow
async def test_every_kind_of_weather_is_survived() -> None:
    recorded = large_recording(agents=network.AGENTS, submaps=network.SUBMAPS)
    figures = await network.campaign(recorded, runs=7, seed=2)
    assert (figures.lost, figures.duplicated, figures.damaged) == (0, 0, 0)
    assert figures.kinds["cut"].resent_share < 0.5
