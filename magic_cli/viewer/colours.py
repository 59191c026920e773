"""The colours of agents and loops, the same in the browser and in a recording."""

from __future__ import annotations

import hashlib

from magic_core.wire.records import LoopCandidate

GREEN, RED, ORANGE = (60, 200, 90), (230, 60, 60), (240, 160, 40)
_PALETTE = ((79, 156, 255), (255, 160, 60), (120, 210, 120), (230, 110, 200), (170, 140, 255),
            (250, 220, 90), (90, 210, 220), (240, 120, 110))  # fmt: skip

_GAMMA = 2.2
Colour = tuple[int, int, int]


def colour_of(agent: str) -> Colour:
    """An agent's colour, the same in every session: by the number that ends its name, or a hash."""
    digits = agent[len(agent.rstrip("0123456789")) :]
    number = int(digits[-6:]) if digits else hashlib.sha256(agent.encode()).digest()[0]
    return _PALETTE[number % len(_PALETTE)]


def on_surface(colour: Colour) -> Colour:
    """What the page must be sent for vertices to get a colour: it takes theirs as linear light."""
    red, green, blue = (round(255 * (value / 255) ** _GAMMA) for value in colour)
    return red, green, blue


def loop_colour(loop: LoopCandidate) -> Colour:
    """Green: relied on. Orange: accepted, but unused by the newest solution. Red: rejected."""
    if loop.verdict == "ACCEPTED":
        return GREEN if loop.kept else ORANGE
    return RED
