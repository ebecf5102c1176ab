"""The pages of docs/tasks/: one for each id, and a table of all.

python docs/task_pages.py

A page is made of the id's docstring, of its picture, and of its rows in benchmarks/results/suite.json, which are made by
training/evaluate.py --suite and training/plan.py; a test holds what is committed against what this makes.  The picture is one of
docs/pictures.py, else the id's film in the gallery.
"""

from __future__ import annotations

import inspect
import re
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym

import clothgym.envs
from clothgym import files
from clothgym.registration import ENVIRONMENTS

HERE = Path(__file__).parent
FILMS = {
    "ClothFlatten-v0": "flatten.gif", "ClothFlatten-Hard-v0": "flatten.png", "ClothFold-v0": "fold.gif", "ClothHang-v0": "hang.png",
    "ClothHang-Hard-v0": "hang.gif", "ClothFling-v0": "fling.gif", "ClothFling-Hard-v0": "fling.png",
    "ClothHook-v0": "hook.png", "ClothHook-Hard-v0": "hook.gif",
}  # fmt: skip
ROOT, PAGES = HERE.parent, HERE / "tasks"
RESULTS = ROOT / "benchmarks" / "results" / "suite.json"
COMMAND = "python training/evaluate.py --suite --json benchmarks/results/suite.json"
for folder in (HERE, ROOT / "training"):
    if str(folder) not in sys.path:
        sys.path.insert(0, str(folder))

import gallery  # noqa: E402 - a script beside this one
import results  # noqa: E402 - scripts of training/
import suite  # noqa: E402

Suite = dict[str, Any]  # what the file of scores holds
NOTHING: Suite = {"rows": []}


def read_scores(path: Path = RESULTS) -> Suite:
    """The file of a suite's scores, of whatever machine; without one there are no rows."""
    return files.read_json(path, "file of a suite's scores", f"make it with  {COMMAND}") if path.exists() else NOTHING


def all_pages(scores: Suite) -> dict[str, str]:
    """Every page's text by the name of its file."""
    pages = {f"{env_id}.md": page(env_id, scores) for env_id in ENVIRONMENTS}
    return pages | {"README.md": index(scores)}


def page(env_id: str, scores: Suite) -> str:
    """One id's page."""
    made = getattr(clothgym.envs, f"{ENVIRONMENTS[env_id][0]}Env")
    source = Path(inspect.getsourcefile(made) or "").name
    manual = _linked(inspect.getdoc(made) or "", env_id)
    # the first line, the picture, and the rest
    first, _, rest = manual.partition("\n")
    parts = [f"# {env_id}", first, _picture(env_id), _facts(env_id), rest.strip(), "## Scores", _scores(env_id, scores)]
    made_of = (
        f"Made by `python docs/task_pages.py` from the docstring in [`envs/{source}`](../../envs/{source}) and the suite's scores."
    )
    return "\n\n".join(part for part in (*parts, made_of) if part) + "\n"


def _linked(text: str, own: str) -> str:
    """A page with links to those of other ids."""
    others = "|".join(re.escape(env_id) for env_id in ENVIRONMENTS if env_id != own)
    return re.sub(rf"``({others})``", r"[`\1`](\1.md)", text)


def _picture(env_id: str) -> str:
    """The id's picture as a link, if there is one in the repository."""
    clips = [gallery.HERE / f"{name}.gif" for name, clip in gallery.CLIPS.items() if clip.name == env_id]
    for path in ([HERE / FILMS[env_id]] if env_id in FILMS else []) + clips:
        if path.exists():
            return f"![{env_id}](../{path.relative_to(HERE).as_posix()})"
    return ""


def _sheet(task: Any) -> str:
    mesh = task.physics.mesh
    particles = " x ".join(map(str, mesh.shape)) if mesh.shape else str(mesh.num_particles)
    return f"{task.physics.side:g} m, {particles} particles"


def _time(task: Any) -> str:
    """How many steps, and how long they are."""
    settling = f" and {task.settling_steps} to settle" if task.settling_steps else ""
    return f"{task.acting_steps} steps{settling}, {round(1 / task.physics.time_step)} Hz"


def _size(space: gym.Space) -> str:
    """The shape of a space: of a Box as numbers, of a Dict by name."""
    if isinstance(space, gym.spaces.Dict):
        return ", ".join(f"{name} {_size(one)}" for name, one in space.items())
    return " x ".join(map(str, space.shape or (1,)))


def _facts(env_id: str) -> str:
    """What one wants to know first."""
    env = gym.make(env_id).unwrapped
    task: Any = env.task  # type: ignore[attr-defined]
    rows = [
        ("sheet", _sheet(task)),
        ("episode", _time(task)),
        ("actions", _size(env.action_space)),
        ("observations", _size(env.observation_space)),
        ("make", f'`gym.make("clothgym:{env_id}")`, `gym.make_vec("clothgym:{env_id}", num_envs=256)`'),
    ]
    env.close()
    return "\n".join(["| | |", "| --- | --- |", *(f"| {name} | {value} |" for name, value in rows)])


def _scores(env_id: str, scores: Suite) -> str:
    """The table of an id's rows, and how they were made; what is of other code is marked."""
    digests = results.read_digests()
    rows = [row for row in scores["rows"] if row["env"] == env_id]
    if not rows:
        return f"None are committed yet; this makes them: `{COMMAND} --env {env_id}`, and `python docs/task_pages.py` the page."
    lines = [suite.cells(row) for row in rows]
    for line, row in zip(lines, rows):
        line["policy"] += "" if results.is_present(row, digests) else " **(old)**"
    columns = [name for name in lines[0] if any(line[name] for line in lines)]
    table = [f"| {' | '.join(columns)} |", "|" + " --- |" * len(columns)]
    table += [f"| {' | '.join(line[name] for name in columns)} |" for line in lines]
    machine, planned = scores["machine"], any(row["policy"].startswith("cem") for row in rows)
    seeds = ", ".join(str(seed) for seed in sorted({row["seed"] for row in rows}))
    said = [
        f"`{COMMAND}`{', and `python training/plan.py` for `cem`' if planned else ''}; {machine['processor']}, {machine['date']}."
    ]
    said += [f"Episodes from seed {seeds} on, which no training uses; means and rates with their 95 % intervals (rates: Wilson's)."]
    said += ["Score: `normalized_performance`."]
    if "held" in columns:
        said += ["Success: in the last step; held: from its first success on to the end."]
    if "best" in columns:
        said += ["Best: the best score of an episode."]
    said += [f"What has been learned is in [results](../results.md#{env_id.lower()})."] if "-Hard-" not in env_id else []
    return "\n".join([*table, "", "\n".join(said)])


def index(scores: Suite) -> str:
    """The table of all tasks."""
    rows = [
        "| id | goal | sheet | episode | actions | expert's score | its success |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    digests = results.read_digests()
    for env_id, (_, goal) in ENVIRONMENTS.items():
        env = gym.make(env_id).unwrapped
        task: Any = env.task  # type: ignore[attr-defined]
        row = next(
            (row for row in scores["rows"] if (row["env"], row["policy"], row["env_kwargs"]) == (env_id, "expert", {})), None
        )
        cells = suite.cells(row) if row else {"score": "", "success": ""}
        if row and not results.is_present(row, digests):
            cells["score"] += " **(old)**"
        about = f"{_sheet(task)} | {_time(task)} | {_size(env.action_space)}"
        rows.append(f"| [`{env_id}`]({env_id}.md) | {goal} | {about} | {cells['score']} | {cells['success']} |")
        env.close()
    said = [
        "The scripted expert's scores are on held-out seeds; each page has them beside those of doing nothing, of chance and of",
        f"what was planned or learned: `{COMMAND}`.",
        "The pages are made by `python docs/task_pages.py`.",
    ]
    return "\n".join(["# Tasks", "", *rows, "", *said]) + "\n"


def main() -> None:
    PAGES.mkdir(exist_ok=True)
    pages = all_pages(read_scores())
    for path in PAGES.glob("*.md"):
        if path.name not in pages:
            path.unlink()
            print(f"{path}: removed, there is no such id")
    for name, text in pages.items():
        (PAGES / name).write_text(text)
        print(PAGES / name)


if __name__ == "__main__":
    main()
