"""What the viewer has of a small session, without a server."""

from __future__ import annotations

from magic_cli.viewer.model import SessionView, SubmapView
from magic_core.geometry import se3
from magic_core.wire.records import ComponentInfo, CorrectedPose, PoseSnapshot
from tests.small_world import make_submap, path


def viewed_session(*agents_of_components: tuple[int, ...]) -> SessionView:
    """Two sub-maps of each agent, the agents of one tuple in one component, at the true poses."""
    view = SessionView("room")
    poses, components = {}, []
    for agents in agents_of_components:
        first = make_submap(agent=agents[0]).name
        names = []
        for agent in agents:
            for index in range(2):
                submap = make_submap(agent=agent, index=index)
                view.submaps[submap.name] = SubmapView.of(submap)
                pose = se3.inverse(path(agents[0], 4)[0]) @ path(agent, 4)[index]
                poses[submap.name] = CorrectedPose(submap.name, first, pose)
                names.append(submap.name)
        components.append(
            ComponentInfo(
                first, len(names), tuple(f"sessions/room/agents/agent_{a}" for a in agents)
            )
        )
    view.snapshot = PoseSnapshot("sessions/room", 3, None, poses, tuple(components))
    return view
