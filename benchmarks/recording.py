"""Speed of training/record.py: frames/s of 64 environments of ClothFold-v0 with the scripted expert, on one core.

    pip install ".[record]"
    python benchmarks/recording.py             # writes benchmarks/results/recording.json

A whole recording is timed, in processor time: 64 episodes run, kept one by one, and written as a set; kernels are compiled before.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from pathlib import Path

from cases import Case, Row, fill, parsed, table

sys.path.insert(0, str(Path(__file__).parent.parent / "training"))

RESULT = Path(__file__).parent / "results" / "recording.json"
CASES = [
    {"format": "lerobot", "obs_mode": "keypoints", "pictures": "png"},
    {"format": "minari", "obs_mode": "keypoints", "pictures": "png"},
    {"format": "robomimic", "obs_mode": "keypoints", "pictures": "png"},
    {"format": "lerobot", "obs_mode": "rgb", "pictures": "png"},
    {"format": "lerobot", "obs_mode": "rgb", "pictures": "video"},
]
ABOUT = {
    "scene": "ClothFold-v0, 64 episodes of 64 environments, expert, one thread; pictures of 64 x 64; processor time of the process"
}


def measure(format: str, obs_mode: str, pictures: str) -> Row:
    """One recording, after a short one that loads or compiles the kernels."""
    import record
    import recordings

    with tempfile.TemporaryDirectory() as folder:
        for episodes in (1, 64):
            out = Path(folder) / str(episodes)
            args = record.Args(
                "ClothFold-v0", episodes=episodes, format=format, obs_mode=obs_mode, pictures=pictures, threads=1, out=out
            )
            begun = time.process_time()
            record.main(args)
            seconds = time.process_time() - begun
        frames = sum(episode["length"] for episode in recordings.read_about(out)["list"])
        size = sum(path.stat().st_size for path in out.rglob("*") if path.is_file())
    return {"frames": frames, "frames/s": frames / seconds, "kB a frame": size / frames / 1000}


def main() -> None:
    args = parsed(__doc__)
    cases: dict[str, list[Case]] = {"recording": [(measure, case) for case in CASES]}
    results = fill(RESULT, cases, args.select, args.fresh, ABOUT)
    RESULT.write_text(json.dumps(results, indent=1) + "\n")
    print(table(results["recording"]))


if __name__ == "__main__":
    main()
