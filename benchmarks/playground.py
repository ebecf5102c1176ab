"""What a frame of the playground costs its server: a scene's two control steps, its readings and its message to the browser.

    python benchmarks/playground.py                  # prints, and writes benchmarks/results/playground.json
    python benchmarks/playground.py --only patch     # prints

Processor time of this process, not time that passes, so that other work on the machine counts little.  A frame is 33.3 ms: a scene
that costs less keeps up with time.  "strict" is the sheet over a sphere with strict self-collision.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np

from clothgym.lab.bench import machine
from clothgym.playground.gallery import Gallery
from clothgym.playground.page import Page
from clothgym.playground.scenes import SCENES
from clothgym.simulation import GRAVITY

RESULTS = Path(__file__).parent / "results" / "playground.json"
SECONDS = 10.0  # of each scene


class Nobody:
    """A browser that only counts the bytes of its frames."""

    size = 0

    def tell(self, what: str, content: Any) -> None:
        pass

    def draw(self, frame: bytes) -> None:
        self.size = len(frame)


def measure(scene: str) -> dict[str, Any]:
    """Processor time of the frames of a scene, under gravity."""
    browser = Nobody()
    page = Page(browser, Gallery(), "sphere" if scene == "strict" else scene)
    page.order("change", {"gravity": GRAVITY} | ({"self_collision": "strict"} if scene == "strict" else {}))
    page.tick()  # compiles
    spent = []
    for _ in range(round(SECONDS / page.stage.recording.time_step)):
        begun = time.process_time()
        page.tick()
        spent.append(1e3 * (time.process_time() - begun))
    rows, columns = page.stage.recording.mesh.grid_shape
    median, often, most = np.percentile(spent, (50, 95, 100)).round(1).tolist()
    return {
        "scene": scene,
        "sheet": f"{rows} x {columns}",
        "median [ms]": median,
        "95th percentile [ms]": often,
        "maximum [ms]": most,
        "message [kB]": round(browser.size / 1e3, 1),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description="What a frame of the playground costs its server.")
    parser.add_argument("--only", nargs="+", default=[], help="scenes")
    only = parser.parse_args().only
    rows = []
    for scene in only or [*SCENES, "strict"]:
        rows.append(measure(scene))
        print(", ".join(f"{name} {value}" for name, value in rows[-1].items()), flush=True)
    if not only:
        RESULTS.write_text(json.dumps({"machine": machine(), "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
