"""The picture of the playground's page: python docs/playground_pictures.py"""

from __future__ import annotations

import shutil
import time
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
from pictures import write
from playwright.sync_api import sync_playwright

from clothgym.playground.server import serve

HERE = Path(__file__).parent
FLAGS = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]
WINDOW = {"width": 1280, "height": 760}
DEADLINE = 120.0  # [s]


def wait(tab: Any, what: Any) -> None:
    end = time.monotonic() + DEADLINE
    while not what():
        if time.monotonic() > end:
            raise TimeoutError("the page did not get there")
        tab.wait_for_timeout(50)


def main() -> None:
    playground = serve("patch", port=0)
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS)
        tab = browser.new_page(viewport=WINDOW)
        tab.goto(playground.url)
        wait(tab, lambda: any(visit.page is not None for visit in playground.visits))
        page = playground.visits[0].page
        assert page is not None
        shots = []
        page.order("change", {"gravity": 9.81})
        wait(tab, lambda: page.stage.frame.positions[0, :, 2].min() < 0.3)
        page.order("press", "play")
        shots.append(shot(tab))
        page.order("press", "play")
        page.order("preset", "Make it explode")
        wait(tab, lambda: "burst" in page.stage.notes)
        wait(tab, lambda: len(page.stage.recording.frames) > 12)
        page.order("press", "play")
        shots.append(shot(tab))
        browser.close()
    playground.stop()
    write(HERE / "playground.webp", np.concatenate(shots, axis=0))
    print(f"written to {HERE / 'playground.webp'}")


def shot(tab: Any) -> Any:
    """What the window shows, (height, width, 3), once the browser has caught up."""
    drawn = "() => new Promise(done => { let n = 0; (function next() { n++ < 4 ? requestAnimationFrame(next) : done(); })(); })"
    tab.evaluate(drawn)
    return iio.imread(tab.screenshot(timeout=1e3 * DEADLINE), extension=".png")[:, :, :3]


if __name__ == "__main__":
    main()
