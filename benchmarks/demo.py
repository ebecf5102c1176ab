"""What a frame of the demo's own sheet costs a browser: a control step in JavaScript, and frames a second with the picture.

    python benchmarks/demo.py             # writes benchmarks/results/demo.json; needs playwright and Chromium

A step is that of ``docs/demo/cloth.js`` with the bits of the core, and 60 of them a second are real time.  Headless Chromium draws
without a GPU, on the processor: its frames a second are a lower bound for a browser that has one.
"""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path
from typing import Any

from cases import Case, Row, fill, parsed, table
from playwright.sync_api import Route, sync_playwright

ROOT = Path(__file__).parent.parent
DEMO = ROOT / "docs" / "demo"
sys.path.insert(0, str(DEMO))

RESULT = Path(__file__).parent / "results" / "demo.json"
WINDOWS = {"desktop": (1440, 900), "phone": (390, 844)}
ABOUT = {"scene": "the sheet of docs/demo, hung by its upper corners; semi-implicit Euler; headless Chromium without a GPU"}
# milliseconds of a step, the median of as many
STEP = """() => {
  const { cloth } = page.hand, spent = [];
  for (let k = 0; k < 120; k++) { const begun = performance.now(); cloth.step(); spent.push(performance.now() - begun); }
  return spent.sort((a, b) => a - b)[60];
}"""
# frames in five seconds, a second, and steps that the sheet took in them
FRAMES = """() => new Promise((done) => {
  const first = performance.now(), { cloth } = page.hand, from = cloth.time;
  let count = 0;
  const next = (now) => {
    count += 1;
    if (now - first < 5000) requestAnimationFrame(next);
    else done([(1000 * count) / (now - first), (1000 * (cloth.time - from)) / (now - first)]);
  };
  requestAnimationFrame(next);
})"""


def measure(rows: int, fabric: str, window: str) -> Row:
    """Cost of a step, frames a second, and how fast the sheet's time goes, with so many particles along a side."""
    from sheet import written

    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        width, height = WINDOWS[window]
        page = browser.new_page(viewport={"width": width, "height": height})

        def other(route: Route) -> None:
            route.fulfill(content_type="text/javascript", body=written(rows))

        page.route("**/sheet.js", other)
        page.goto(f"{(DEMO / 'index.html').as_uri()}#hand")
        page.wait_for_function("() => typeof page !== 'undefined' && page.episode === page.hand")
        page.evaluate(f"page.hand.set('fabric', {json.dumps(fabric)})")
        page.wait_for_timeout(2000)
        frames, pace = page.evaluate(FRAMES)
        step: Any = page.evaluate(STEP)
        substeps = page.evaluate("page.hand.cloth.substeps")
        browser.close()
    return {"substeps": substeps, "ms_a_step": step, "frames_per_second": frames, "share_of_real_time": pace}


def cases() -> list[Case]:
    """All of them: both sizes of the sheet on a desktop, and the page's own size on a phone."""
    from sheet import FABRICS, ROWS

    rows: list[Row] = [{"rows": n, "fabric": name, "window": "desktop"} for n in (ROWS, 49) for name in FABRICS]
    rows.append({"rows": ROWS, "fabric": next(iter(FABRICS)), "window": "phone"})
    return [(measure, row) for row in rows]


if __name__ == "__main__":
    args = parsed(__doc__)
    results = fill(RESULT, {"rows": cases()}, args.select, args.fresh, ABOUT)
    print(table(results["rows"]))
