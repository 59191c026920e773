"""What a live agent leaves out when time runs short: mapping first, then frames."""

from __future__ import annotations

from dataclasses import dataclass, field

import pytest

from magic_agent.pace import Pace

RATE_HZ, QUEUE = 30.0, 4
KEYFRAME_EVERY = 5


@dataclass
class Outcome:
    dropped: int = 0
    late_s: list[float] = field(default_factory=list)
    mapping_s: float = 0.0
    wanted_s: float = 0.0


def play(*, tracking_s: float, keyframe_s: float, frames: int = 300) -> Outcome:
    """Frames of a camera through a queue to an agent whose work takes simulated time.

    Every fifth frame would like `keyframe_s` of mapping, which can be cut at any point.
    """
    now, outcome = 0.0, Outcome()
    pace = Pace(RATE_HZ, queue_frames=QUEUE, clock=lambda: now)
    pace.late_s(0)
    number, waiting = 0, []

    def arrive(until: float) -> None:
        nonlocal number
        while number < frames and number / RATE_HZ <= until:
            if len(waiting) < QUEUE:
                waiting.append(number)
            else:
                outcome.dropped += 1
            number += 1

    while number < frames or waiting:
        arrive(now)
        if not waiting:
            now += pace.wait_s(number) + 1e-9
            continue
        frame = waiting.pop(0)
        outcome.late_s.append(pace.late_s(frame))
        wanted = keyframe_s if frame % KEYFRAME_EVERY == 0 else 0.0
        mapped = max(0.0, min(wanted, pace.mapping_s(frame)))
        outcome.wanted_s += wanted
        outcome.mapping_s += mapped
        pace.note_tracking(tracking_s)
        now += tracking_s + mapped
    return outcome


def test_an_agent_with_time_enough_maps_all_and_drops_nothing():
    outcome = play(tracking_s=0.010, keyframe_s=0.060)
    assert outcome.dropped == 0
    assert outcome.mapping_s == pytest.approx(outcome.wanted_s)


def test_mapping_gives_way_before_a_single_frame_is_dropped():
    outcome = play(tracking_s=0.025, keyframe_s=0.300)
    assert outcome.dropped == 0
    assert 0.0 < outcome.mapping_s < 0.5 * outcome.wanted_s
    assert max(outcome.late_s) < QUEUE / RATE_HZ


def test_time_that_tracking_leaves_goes_to_mapping():
    outcome = play(tracking_s=0.025, keyframe_s=0.300)
    free_s = 300 / RATE_HZ - 300 * 0.025
    assert outcome.mapping_s > 0.8 * free_s


def test_frames_are_dropped_only_when_tracking_alone_is_too_slow():
    outcome = play(tracking_s=0.050, keyframe_s=0.300)
    assert outcome.mapping_s < 0.1 * outcome.wanted_s
    assert 80 <= outcome.dropped <= 110  # a third: 20 frames per second of 30
    assert max(outcome.late_s) < (QUEUE + 2.5) / RATE_HZ


def test_clock_starts_with_the_first_frame_wherever_the_source_is_entered():
    now = 100.0
    pace = Pace(10.0, queue_frames=4, clock=lambda: now)
    assert pace.wait_s(40) == 0.0
    assert pace.wait_s(43) == pytest.approx(0.3)
    now += 0.5
    assert pace.wait_s(43) == 0.0
    assert pace.late_s(43) == pytest.approx(0.2)
