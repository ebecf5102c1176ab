"""How fast the playground's page is: a server and a headless Chromium, which draws in software, on the same machine.

    python benchmarks/playground.py                  # prints, and writes benchmarks/results/playground.json
    python benchmarks/playground.py --seconds 2      # quickly: prints

An update is a new sheet that the server has simulated and sent; 30 a second is as fast as time itself.  Frames are what the
browser has drawn meanwhile: without a graphics card, on the processors that also simulate, they are fewer.  "strict" is the sheet
over a sphere with strict self-collision.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shutil
import statistics
import time
from pathlib import Path
from typing import Any

from playwright.sync_api import sync_playwright

from clothgym.lab.bench import machine
from clothgym.playground.server import Playground, serve
from clothgym.playground.stage import SceneStage

RESULTS = Path(__file__).parent / "results" / "playground.json"
WINDOW = {"width": 1280, "height": 800}
FLAGS = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]
SETTLE, SECONDS, ROUNDS = 3.0, 5.0, 3  # before a measurement [s], of it, and how many: the median counts
CASES = (("patch", 1), ("patch", 2), ("flag", 1), ("sphere", 1), ("box", 1), ("pawn", 1), ("cape", 1), ("fold", 1), ("strict", 2))
DRAWN_TWICE = "() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))"
COUNT_FRAMES = "window.drawn = 0; (function next() { window.drawn++; requestAnimationFrame(next); })()"


def processor_time() -> float:
    """Processors' time of this process and of all that it has started, which still run [s]: a browser is many processes."""
    ticks, parents = {}, {}
    for entry in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            fields = entry.read_text().rpartition(")")[2].split()
            ticks[int(entry.parent.name)], parents[int(entry.parent.name)] = int(fields[11]) + int(fields[12]), int(fields[1])
    mine = {os.getpid()}
    while more := {process for process, parent in parents.items() if parent in mine} - mine:
        mine |= more
    return sum(ticks[process] for process in mine) / os.sysconf("SC_CLK_TCK")


def visits(playground: Playground, count: int) -> list[Any]:
    """The visitors' side on the server, when all have come."""
    end = time.monotonic() + 60
    while time.monotonic() < end:
        come = list(playground.visits)
        if len(come) == count and all(visit.page is not None for visit in come):
            return come
        time.sleep(0.05)
    raise TimeoutError("the page did not open")


def measure(playground: Playground, browser: Any, scene: str, visitors: int, seconds: float) -> dict[str, Any]:
    """Updates a second of each visitor, frames that the browser drew, and what a control step cost."""
    tabs = [browser.new_page(viewport=WINDOW) for _ in range(visitors)]
    begun, spent = time.perf_counter(), processor_time()
    for tab in tabs:
        tab.goto(playground.url)
    come = visits(playground, visitors)
    for tab in tabs:  # the canvas has been drawn twice: the cloth has moved
        tab.evaluate(DRAWN_TWICE)
    loaded, spent = time.perf_counter() - begun, processor_time() - spent
    for visit in come:
        visit.page.order("open", "sphere" if scene == "strict" else scene)
        if scene == "strict":
            visit.page.order("change", {"self_collision": "strict"})
        visit.page.order("change", {"gravity": 9.81})
    for tab in tabs:
        tab.evaluate(COUNT_FRAMES)
    time.sleep(SETTLE)
    updates, frames, costs = [], [], []
    for _ in range(ROUNDS):
        before, drawn = [visit.frames for visit in come], [tab.evaluate("window.drawn") for tab in tabs]
        begun = time.perf_counter()
        time.sleep(seconds)
        passed = time.perf_counter() - begun
        updates.append(min(visit.frames - first for visit, first in zip(come, before)) / passed)
        frames.append(min(tab.evaluate("window.drawn") - first for tab, first in zip(tabs, drawn)) / passed)
        stage = come[0].page.stage
        assert isinstance(stage, SceneStage)
        costs.append(1e3 * stage.cost)
    shape = stage.scene.mesh.shape or (0, 0)
    for tab in tabs:
        tab.close()
    visits(playground, 0)
    return {
        "scene": scene,
        "sheet": f"{shape[0]} x {shape[1]}",
        "visitors": visitors,
        "first moving cloth [s]": round(loaded, 1),
        "of processors [s]": round(spent, 1),
        "updates/s": round(statistics.median(updates), 1),
        "least updates/s": round(min(updates), 1),
        "drawn frames/s": round(statistics.median(frames), 1),
        "control step [ms]": round(statistics.median(costs), 2),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description="How fast the playground's page is.")
    parser.add_argument("--only", nargs="+", default=[], help="scenes")
    parser.add_argument("--seconds", type=float, default=SECONDS, help="of each measurement")
    options = parser.parse_args()
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    rows = []
    playground = serve("patch", port=0)
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=chromium, args=FLAGS)
        for scene, visitors in (case for case in CASES if not options.only or case[0] in options.only):
            # compiled before anything is measured
            stage = playground.gallery.open("sphere" if scene == "strict" else scene)
            if scene == "strict":
                stage.change(self_collision="strict")
            stage.advance()
            rows.append(measure(playground, browser, scene, visitors, options.seconds))
            print(", ".join(f"{name} {value}" for name, value in rows[-1].items()))
        version = browser.version
        browser.close()
    playground.stop()
    if options.seconds == SECONDS and not options.only:
        about = {"browser": f"Chromium {version}, SwiftShader", "window": WINDOW}
        RESULTS.write_text(json.dumps({"machine": machine(), **about, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
