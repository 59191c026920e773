"""`magic run --viewer --rerun` with three agents, watched in a real headless Chromium.

Its pictures are kept under build/viewer: run-during, run-agents, run-end, run-rejected-loop,
run-keyframe.
"""

from __future__ import annotations

import asyncio
import importlib.util
import json
import re

import pytest
import pytest_asyncio

from magic_core.data import write_replica
from magic_core.data.synthetic import SyntheticConfig, synthetic_flat
from magic_core.evaluation import RunFolder
from tests.end_to_end.browser import (
    MARKS,
    dismiss_notices,
    page_in_chromium,
    says,
    screenshot,
    settled_share,
)
from tests.end_to_end.conftest import Processes, first_line, wait_until

pytestmark = MARKS
FLAT = SyntheticConfig(agents=3, frames=100, width=160, height=120)
HAS_RERUN = importlib.util.find_spec("rerun") is not None


@pytest.fixture(scope="module")
def running(tmp_path_factory):
    """A run in progress: (its folder, its process, the page's address, what it printed so far)."""
    folder = tmp_path_factory.mktemp("watched")
    data = write_replica(synthetic_flat(FLAT), folder / "data")
    children = Processes(folder)
    recording = ["--rerun", str(folder / "run.rrd")] if HAS_RERUN else []
    process = children.start(
        "run", "run", str(data), "--out", str(folder / "out"), "--json", "--viewer", *recording,
        "--viewer-splats", "20000",  # what a browser without a GPU draws on a busy machine
        "--submap.frames", "15", "--submap.min-frames", "10", "--merge.iterations", "60",
        "--candidates.min-similarity", "0.3", "--candidates.top-k", "3", "--no-report",
    )  # fmt: skip
    address = re.compile(r"Open (http://\S+) in a browser")
    try:
        wait_until(lambda: address.search(children.log("run")), timeout_s=900)
        yield folder, process, address.search(children.log("run")).group(1), children
    finally:
        children.stop_all()


@pytest.fixture(scope="module")
def finished(running):
    """The run folder after its end, and what `--json` printed."""
    folder, process, _, children = running
    stdout, _ = process.communicate(timeout=1500)
    assert process.returncode == 0, children.log("run")
    return RunFolder(folder / "out"), json.loads(stdout.strip().splitlines()[-1])


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def tab(finished, running):
    """The finished run in the browser, through `magic view RUN`."""
    folder, metrics = finished
    children = running[3]
    process = children.start("view", "view", str(folder.path), "--progress", "json", "--port", "0",
                             "--max-splats", "20000")  # fmt: skip
    address = (await asyncio.to_thread(first_line, process))["page"]
    async with page_in_chromium(address) as tab:
        await says(tab, f"{metrics['submaps']} sub-maps in")
        await says(tab, "showing the merged map")
        await dismiss_notices(tab)
        yield tab
    process.terminate()
    process.communicate(timeout=60)


async def test_the_map_grows_in_the_browser_while_agents_run(running):
    _, process, address, _ = running
    async with page_in_chromium(address) as tab:
        await tab.wait_for_function(
            "() => /\\b([3-9]|\\d\\d) sub-maps in/.test(document.body.innerText)"
        )
        await dismiss_notices(tab)
        assert process.poll() is None
        await tab.get_by_role("tab", name="Agents").click()
        await says(tab, "active")  # before the picture: drawing takes long without a GPU
        await says(tab, "agent_2")
        await screenshot(tab, "run-agents")
        await tab.get_by_role("tab", name="Map").click()
        assert await settled_share(tab, "run-during", least=0.1) >= 0.1


async def test_the_end_shows_the_merged_map_and_every_trajectory(tab):
    assert await settled_share(tab, "run-end", least=0.1) >= 0.1
    await tab.get_by_label("tracked paths", exact=True).check()
    await tab.get_by_label("keyframes", exact=True).check()
    await tab.wait_for_timeout(2000)
    await screenshot(tab, "run-end-layers")


async def test_a_rejected_loop_is_highlighted_with_its_reason(tab, finished):
    folder, _ = finished
    rejected = [loop for loop in folder.read_loops() if not loop.accepted]
    assert rejected, "no candidate was rejected: the test needs another threshold"
    await tab.get_by_role("tab", name="Loops").click()
    await tab.get_by_label("candidate", exact=True).click()
    await tab.get_by_text(re.compile("REJECTED")).first.click()
    await tab.get_by_role("button", name="look at it").click()
    await tab.wait_for_function(
        "reasons => reasons.some(r => document.body.innerText.includes(r))",
        arg=[loop.reason for loop in rejected],
    )
    await tab.wait_for_timeout(3000)
    await screenshot(tab, "run-rejected-loop")


async def test_a_keyframe_stands_beside_its_rendering(tab):
    await tab.get_by_role("tab", name="Keyframe").click()
    await tab.get_by_label("sub-map", exact=True).click()
    await tab.get_by_text("agent_1/1", exact=True).first.click()
    await says(tab, "PSNR")
    await tab.wait_for_timeout(1000)
    await screenshot(tab, "run-keyframe")
    text = await tab.inner_text("body")
    assert float(re.search(r"PSNR ([0-9.]+) dB", text).group(1)) > 18.0


@pytest.mark.skipif(not HAS_RERUN, reason="needs the extra `rerun` (rerun-sdk)")
async def test_the_recording_holds_the_whole_run(running, finished):
    from rerun.chunk import RrdReader

    _, metrics = finished
    recorded = str(running[0] / "run.rrd")
    entities = {str(chunk.entity_path) for chunk in RrdReader(recorded).stream().to_chunks()}
    submaps = {name for name in entities if re.fullmatch(r"/map/agent_\d/\d+", name)}
    assert len(submaps) == metrics["submaps"]
    assert {f"/trajectories/agent_{i}/corrected" for i in range(3)} <= entities
    assert {"/merged/0/points", "/loops/verdicts", "/agents/agent_2/camera/image"} <= entities
