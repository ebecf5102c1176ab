"""Count the files of a folder that ``clothgym.load_mesh`` accepts, its warnings, and its reasons for refusing others.

python benchmarks/mesh_files.py FOLDER [--scale 0.01] [--merge-tolerance 0.01]
"""

from __future__ import annotations

import argparse
import re
import warnings
from collections import Counter
from pathlib import Path

import clothgym

ENDINGS = (".obj", ".ply", ".off", ".stl", ".glb")


def outcome(path: Path, scale: float, merge_tolerance: float) -> str:
    """What becomes of one file: its warning or its refusal, without names and numbers."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            clothgym.load_mesh(path, scale=scale, merge_tolerance=merge_tolerance)
            text = "; ".join(str(warning.message) for warning in said)
            kind = "loaded" + (": " if text else "")
        except ValueError as error:
            text, kind = str(error), "refused: "
    text = re.sub(r"^'.*?'( is not a sheet)?: ", "", text)
    return kind + re.sub(r"\d[\d.e-]*", "n", re.sub(r"\([-\d., e]+\)", "(x, y, z)", text))


def main() -> None:
    """Print the outcomes by count."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scale", type=float, default=1.0, help="meters in the files' unit")
    parser.add_argument("--merge-tolerance", type=float, default=0.0, help="distance of vertices that are joined [m]")
    args = parser.parse_args()
    files = sorted(path for path in args.folder.rglob("*") if path.suffix.lower() in ENDINGS)
    for text, count in Counter(outcome(path, args.scale, args.merge_tolerance) for path in files).most_common():
        print(f"{count:5d}  {text}")
    print(f"{len(files):5d}  files")


if __name__ == "__main__":
    main()
