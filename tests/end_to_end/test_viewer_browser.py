"""The live view in a real headless Chromium, fed by a real server."""

from __future__ import annotations

import asyncio
import dataclasses
import re
from collections.abc import AsyncIterator

import numpy as np
import pytest_asyncio

from magic_agent.client import ClientConfig, MagicClient
from magic_cli.viewer.feed import Feed
from magic_cli.viewer.page import Page
from magic_core.geometry import se3
from magic_core.submap import Keyframe, Submap, TrackedFrame
from magic_server.config import ListenConfig, ServerConfig
from magic_server.jobs import JobConfig
from magic_server.loops import LoopConfig
from magic_server.server import Server
from tests.end_to_end.browser import (
    HEIGHT,
    MARKS,
    WIDTH,
    dismiss_notices,
    page_in_chromium,
    says,
    screenshot,
    settled_share,
)
from tests.small_world import DIMENSION, LARGE, MODEL_ID, look, make_submap, render
from tests.small_world import gaussians_of as gaussians

pytestmark = MARKS


def turned_away() -> Submap:
    """A third agent that looks at the opposite wall: a candidate that must be rejected."""
    world_from_anchor = look(0.0, 1.2, np.pi)
    colour, depth = render(LARGE, world_from_anchor)
    first = make_submap(agent=2, index=0, camera=LARGE)
    return dataclasses.replace(
        first,
        gaussians=gaussians(LARGE, colour, depth),
        keyframes=(Keyframe(0, 0.0, se3.identity(), colour, depth),),
        trajectory=(TrackedFrame(0, 0.0, se3.identity()),),
    )


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def shown(tmp_path_factory) -> AsyncIterator[tuple[Page, Feed, MagicClient]]:
    """A page that shows a session of three agents, after its loops were verified."""
    config = ServerConfig(
        data_dir=tmp_path_factory.mktemp("viewer"),
        listen=ListenConfig(port=0, stop_grace_s=2.0),
        jobs=JobConfig(workers=1, niceness=0),
        loops=LoopConfig(min_similarity=-1.0),
    )
    async with (
        Server(config) as server,
        MagicClient(server.address, ClientConfig(rpc_timeout_s=60.0)) as client,
    ):
        for agent in range(3):
            await client.register_agent(
                "room", f"agent_{agent}", model_id=MODEL_ID, dimension=DIMENSION
            )
        for index in range(2):
            for agent in range(2):
                await client.submit_submap(make_submap(agent=agent, index=index, camera=LARGE))
        await client.submit_submap(turned_away())
        assert await (await server.sessions.named("room")).idle(timeout_s=600)
        page = Page(host="127.0.0.1", port=8080, max_splats=20_000)
        feed = Feed(client, session="room", draw=page.update, interval_s=0.2)
        for _ in range(3):
            await feed.refresh()
        yield page, feed, client
        page.close()


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def browser(shown) -> AsyncIterator:
    """The page in Chromium, with software rendering."""
    async with page_in_chromium(shown[0].address) as tab:
        await says(tab, "5 sub-maps in")
        await dismiss_notices(tab)
        yield tab


async def test_splats_appear_and_go_with_their_layer(browser) -> None:
    assert await settled_share(browser, "live", least=0.1) >= 0.1
    await browser.get_by_label("splats", exact=True).uncheck()
    assert await settled_share(browser, "without-splats", most=0.08) < 0.08
    await browser.get_by_label("splats", exact=True).check()
    assert await settled_share(browser, "live", least=0.1) >= 0.1


async def test_agents_are_listed_with_their_health(browser) -> None:
    await browser.get_by_role("tab", name="Agents").click()
    await says(browser, "agent_2")
    text = await browser.inner_text("body")
    assert "active" in text
    assert re.search(r"\d (s|min|h) ago", text)


async def test_a_rejected_loop_tells_its_reason(shown, browser) -> None:
    _, feed, client = shown
    loops = (await client.list_loops("room")).candidates
    rejected = next(c for c in loops if c.verdict == "REJECTED" and "agent_2" in c.source)
    await browser.get_by_role("tab", name="Loops").click()
    await browser.get_by_label("candidate", exact=True).click()
    title = f"agent_2/0 - {'/'.join(rejected.target.split('/')[3::2])}: REJECTED"
    await browser.get_by_text(title).first.click()
    await says(browser, rejected.reason)
    await browser.get_by_role("button", name="look at it").click()
    await feed.refresh()  # which highlights it
    await browser.wait_for_timeout(2000)
    await screenshot(browser, "rejected-loop")
    assert "overlap" in await browser.inner_text("body")


async def test_a_click_on_its_mark_chooses_a_loop(shown, browser) -> None:
    """After `look at it` the mark of the loop is in the middle of the page."""
    await browser.get_by_label("candidate", exact=True).click()
    await browser.get_by_text("none", exact=True).first.click()
    await says(browser, "Choose a candidate")
    await shown[1].refresh()
    for _ in range(20):
        await browser.mouse.click(WIDTH / 2, HEIGHT / 2)
        await browser.wait_for_timeout(1500)
        if "verified in" in await browser.inner_text("body"):
            break
    text = await browser.inner_text("body")
    assert "Loop agent_" in text  # said beside the map
    assert "Choose a candidate" not in text  # and chosen in the list
    await dismiss_notices(browser)


async def test_a_keyframe_is_shown_beside_its_rendering(browser) -> None:
    await browser.get_by_role("tab", name="Keyframe").click()
    await browser.get_by_label("sub-map", exact=True).click()
    await browser.get_by_text("agent_0/1", exact=True).first.click()
    images = "[...document.images].filter(i => i.offsetParent && i.naturalWidth === 256).length"
    await browser.wait_for_function(f"{images} === 2")
    await screenshot(browser, "keyframe")


async def test_the_map_is_exported_from_the_page(browser, tmp_path) -> None:
    from magic_core.gaussians.ply import read_ply

    await browser.get_by_role("tab", name="Export").click()
    async with browser.expect_download() as started:
        await browser.get_by_role("button", name="map as 3DGS PLY").click()
    path = tmp_path / "map.ply"
    await (await started.value).save_as(path)
    assert len(read_ply(path)) > 10_000


async def test_new_sub_maps_arrive_while_the_page_is_open(shown, browser) -> None:
    _, feed, client = shown
    await client.submit_submap(make_submap(agent=0, index=2, camera=LARGE))
    for _ in range(100):
        await feed.refresh()
        if "6 sub-maps in" in await browser.inner_text("body"):
            break
        await asyncio.sleep(0.3)
    assert "6 sub-maps in" in await browser.inner_text("body")
