"""Generate the pages of docs/tasks/: one for each id, and a table of all tasks.

python docs/task_pages.py

A page consists of the id's docstring, its picture, and its rows in benchmarks/results/suite.json, which training/evaluate.py
--suite and training/plan.py write.  A test compares the committed pages with the output of this script.  The picture is one of
docs/pictures.py, else the id's clip in the gallery.
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
ROOT, PAGES = HERE.parent, HERE / "tasks"
RESULTS = ROOT / "benchmarks" / "results" / "suite.json"
COMMAND = "python training/evaluate.py --suite --json benchmarks/results/suite.json"
for folder in (HERE, ROOT / "training"):
    if str(folder) not in sys.path:
        sys.path.insert(0, str(folder))

import gallery  # noqa: E402 - scripts in this folder
import pictures  # noqa: E402
import report  # noqa: E402
import results  # noqa: E402 - scripts of training/
import suite  # noqa: E402

Suite = dict[str, Any]  # content of the file of scores
NOTHING: Suite = {"rows": []}


def read_scores(path: Path = RESULTS) -> Suite:
    """Read the file of a suite's scores, from any machine; no rows if there is no file."""
    return files.read_json(path, "file of a suite's scores", f"make it with  {COMMAND}") if path.exists() else NOTHING


def all_pages(scores: Suite) -> dict[str, str]:
    """Text of every page, by file name."""
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
    link = f"[`envs/{source}`](../../envs/{source})"
    made_of = f"`python docs/task_pages.py` generates this page from the docstring in {link} and the scores."
    return "\n\n".join(part for part in (*parts, made_of) if part) + "\n"


def _linked(text: str, own: str) -> str:
    """A page with links to the pages of other ids."""
    others = "|".join(re.escape(env_id) for env_id in ENVIRONMENTS if env_id != own)
    return re.sub(rf"``({others})``", r"[`\1`](\1.md)", text)


def _picture(env_id: str) -> str:
    """A link to the id's film, or to pictures of its scripted expert, if the repository has one."""
    strips = [HERE / name for name, rows in pictures.STRIPS.items() if env_id in {row.env_id for row in rows}]
    for path in [gallery.HERE / f"{env_id}.webp", *strips]:
        if path.exists():
            return f"![{env_id}](../{path.relative_to(HERE).as_posix()})"
    return ""


def _sheet(task: Any) -> str:
    mesh = task.physics.mesh
    particles = " x ".join(map(str, mesh.shape)) if mesh.shape else str(mesh.num_particles)
    return f"{task.physics.side:.3g} m, {particles} particles"


def _time(task: Any) -> str:
    """Number of steps, and their frequency."""
    settling = f" and {task.settling_steps} to settle" if task.settling_steps else ""
    return f"{task.acting_steps} steps{settling}, {round(1 / task.physics.time_step)} Hz"


def _size(space: gym.Space) -> str:
    """The shape of a space: numbers for a Box, by name for a Dict."""
    if isinstance(space, gym.spaces.Dict):
        return ", ".join(f"{name} {_size(one)}" for name, one in space.items())
    return " x ".join(map(str, space.shape or (1,)))


def _facts(env_id: str) -> str:
    """A table of the basic facts."""
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
    rows += _from_scratch(env_id)
    return "\n".join(["| | |", "| --- | --- |", *(f"| {name} | {value} |" for name, value in rows)])


def _from_scratch(env_id: str) -> list[tuple[str, str]]:
    """How the task is learned best without an expert, and the success of the committed runs as the README has it; nothing if there
    are none."""
    best = report.best_rows(env_id, results.learned(), results.read_digests(), results.FROM_SCRATCH)
    if best is None:
        return []
    # with the arguments of the printed command
    _, runs = best
    algo, config = runs[0]["learner"], results.read_config(results.RUNS / runs[0]["run"], begun=False)
    script = "sac_single_file.py --env" if algo == "sac_scratch" else f"train.py --algo {algo} --env"
    first, begun = config["curriculum"].get("n_timesteps", 0), config["curriculum"].get("env_kwargs", {})
    partly = 0 < first < config["timesteps"]
    said = {**config["env_kwargs"], **({} if partly else begun)}
    said |= {"starts_from": config["started_from"]["env"]} if "started_from" in config else {}
    parts = ["trained with " + ", ".join(f"`{name}={value!r}`" for name, value in said.items())] if said else []
    parts.append(f"{config['timesteps'] / 1e6:.2f} M control steps")
    if partly:
        parts.append(f"the first {first / 1e6:.2f} M with {', '.join(f'`{name}={value!r}`' for name, value in begun.items())}")
    success = f"success {report.interquartile_mean(row['success_rate'] for row in runs):.3f}"
    if "cost" in runs[0]:
        success += f", {report.interquartile_mean(row['safe_success_rate'] for row in runs):.3f} at no cost,"
    command, seeds = f"`python training/{script} {env_id}`", f" ({len(runs)} seeds)" if len(runs) > 1 else ""
    return [("learned from scratch", f"{command}: {', '.join(parts)}; {success} in true physics{seeds}")]


def _scores(env_id: str, scores: Suite) -> str:
    """The table of an id's rows, with their sources; rows of other code are marked."""
    digests = results.read_digests()
    rows = [row for row in scores["rows"] if row["env"] == env_id]
    if not rows:
        return f"None are committed yet. `{COMMAND} --env {env_id}` makes them, and `python docs/task_pages.py` this page."
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
    said += [f"Episodes start from seed {seeds}, which no training uses."]
    said += ["Means and rates have 95 % intervals (rates: Wilson's)."]
    said += ["Score: `normalized_performance`."]
    if "held" in columns:
        said += ["Success: in the last step; held: from its first success to the end."]
    if "best" in columns:
        said += ["Best: the best score of an episode."]
    said += [f"[Results](../results.md#{env_id.lower()}) has the scores of learned policies."] if "-Hard-" not in env_id else []
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
        "The scripted expert's scores are from held-out seeds. Each page compares them with no action and random",
        f"actions (`{COMMAND}`).",
        "`python docs/task_pages.py` generates the pages.",
    ]
    return "\n".join(["# Tasks", "", *tiles(), "", *rows, "", *said]) + "\n"


def tiles(across: int = 3) -> list[str]:
    """Lines of a table of the films that there are, each a link to its task."""
    names = [env_id for env_id in ENVIRONMENTS if (gallery.HERE / f"{env_id}.webp").exists()]
    cells = [f"[![{name}](../gallery/{name}.webp)]({name}.md)<br>{name}" for name in names]
    cells += [""] * (-len(cells) % across)
    lines = [f"| {' | '.join(cells[first : first + across])} |" for first in range(0, len(cells), across)]
    return [f"| {'| ' * across}".rstrip() + "", f"| {'--- | ' * across}".rstrip(), *lines]


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
