"""A real headless Chromium on a viewer's page, and its pictures, kept as artefacts."""

from __future__ import annotations

import asyncio
import contextlib
import io
import shutil
from collections.abc import AsyncIterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
ARTEFACTS = Path(__file__).resolve().parents[2] / "build" / "viewer"
SLOW_MS = 180_000
BACKGROUND = np.array([22, 26, 34])
WIDTH, HEIGHT = 1440, 900
MAP_AREA = (0, 0, 1000, HEIGHT)
"""Left, top, right, bottom of what lies beside the panel."""
MARKS = [
    pytest.mark.asyncio(loop_scope="module"),
    pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium (apt-get install chromium)"),
    pytest.mark.slow,
]
"""Of every test of a page: `pytestmark = MARKS`."""


@contextlib.asynccontextmanager
async def page_in_chromium(address: str) -> AsyncIterator:
    """The page at an address, with software rendering."""
    playwright = pytest.importorskip("playwright.async_api")
    async with playwright.async_playwright() as driver:
        chromium = await driver.chromium.launch(
            executable_path=CHROMIUM,
            args=["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
                  "--ignore-gpu-blocklist", "--disable-quic"],
        )  # fmt: skip
        try:
            tab = await chromium.new_page(viewport={"width": WIDTH, "height": HEIGHT})
            tab.set_default_timeout(SLOW_MS)
            await tab.goto(address)
            await tab.wait_for_selector("canvas")
            yield tab
        finally:
            await chromium.close()


async def dismiss_notices(tab) -> None:
    """Close what lies over the picture, such as the notice that no GPU renders.

    Another may come meanwhile, and one that goes by itself cannot be clicked: it is no failure.
    """
    for _ in range(60):
        left = await tab.evaluate(
            "(() => { const all = document.querySelectorAll('.mantine-Notification-root button');"
            " all.forEach(button => button.click()); return all.length; })()"
        )
        if not left:
            break
        await tab.wait_for_timeout(500)


async def says(tab, text: str) -> None:
    """Wait until the page says something."""
    await tab.wait_for_function("text => document.body.innerText.includes(text)", arg=text)


async def screenshot(tab, name: str) -> np.ndarray:
    """A picture of the page (h, w, 3), kept under build/viewer."""
    ARTEFACTS.mkdir(parents=True, exist_ok=True)
    data = await tab.screenshot(path=ARTEFACTS / f"{name}.png", timeout=SLOW_MS)
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))


def shown_share(picture: np.ndarray, area: tuple[int, int, int, int]) -> float:
    """The share of an area (left, top, right, bottom) that is not background."""
    left, top, right, bottom = area
    part = picture[top:bottom, left:right].astype(int)
    return float((np.abs(part - BACKGROUND).max(axis=2) > 25).mean())


async def settled_share(tab, name: str, *, least: float = 0.0, most: float = 1.0) -> float:
    """The share of the map's area that is drawn, once it lies in a range; keeps the picture."""
    share = -1.0
    for _ in range(40):
        share = shown_share(await screenshot(tab, name), MAP_AREA)
        if least <= share <= most:
            break
        await asyncio.sleep(1.0)
    return share
