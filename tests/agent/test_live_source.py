"""An agent on a camera that ends when it is unplugged, not when a list is at its end."""

from __future__ import annotations

from magic_agent.agent import Agent
from magic_agent.config import AgentConfig
from magic_agent.places import load_descriptor_model
from magic_core.data import UNLIMITED, EndOfFrames, Frame
from magic_core.evaluation.frame_records import read_frame_records
from tests.core.small_flat import small_flat, small_frames

DELIVERED = 9


class UnpluggedCamera:
    """The flat's first walk, live: always the next frame, until the plug is pulled."""

    def __init__(self) -> None:
        self.name = "robot"
        self.camera = small_flat()[0].camera
        self._next = 0

    def __len__(self) -> int:
        return UNLIMITED

    def __getitem__(self, index: int) -> Frame:
        if self._next == DELIVERED:
            raise EndOfFrames("the camera sends no more frames")
        self._next += 1
        return small_frames(0)[self._next - 1]


async def test_what_a_camera_showed_is_sent_when_it_is_unplugged(client, tmp_path, caplog):
    said: list[dict] = []
    agent = Agent(
        UnpluggedCamera(), client, session="live", name="robot", config=AgentConfig(),
        model=load_descriptor_model(), folder=tmp_path / "robot",
        observer=lambda event, figures: said.append(figures) if event == "frame" else None,
    )  # fmt: skip
    tally = await agent.run()
    assert said[-1]["frames"] == DELIVERED
    assert {figures["of"] for figures in said} == {None}  # nobody knows how many will come
    assert tally.completed
    assert (tally.frames, tally.acknowledged) == (DELIVERED, 1)
    assert "no more frames" in caplog.text
    (stored,) = await client.list_submaps("live")
    assert stored.name.endswith("robot/submaps/0")
    records = read_frame_records(tmp_path / "robot" / "frames.csv")
    assert [record.frame for record in records] == list(range(DELIVERED))
