"""What the pages show runs: Python samples and doctests are executed, and commands have the options that are named.

Some pages are run elsewhere, see ``ELSEWHERE``: those of other libraries need an environment of their own.
"""

import contextlib
import doctest
import io
import re
import runpy
import shlex
import sys
import tomllib
from pathlib import Path

import gymnasium as gym
import pytest

import clothgym
import clothgym.envs
import clothgym.render
from clothgym import cli
from clothgym.registration import ENVIRONMENTS

ROOT = Path(__file__).parent.parent
PAGES = {
    path.relative_to(ROOT).as_posix(): path.read_text() for path in [*ROOT.glob("*.md"), *sorted((ROOT / "docs").rglob("*.md"))]
}
API = sorted((ROOT / "docs" / "api").glob("*.rst"))
BLOCKS = {name: re.findall(r"^```(\w*)\n(.*?)^```", page, re.DOTALL | re.MULTILINE) for name, page in PAGES.items()}
PYTHON = {name: [text for language, text in blocks if language == "python"] for name, blocks in BLOCKS.items()}
ELSEWHERE = {"docs/clients.md": "clients"}
# pages whose blocks run each by itself; those of others continue one another
ALONE = [name for name, blocks in PYTHON.items() if blocks and (name == "README.md" or name.startswith("docs/howto/"))]
SAMPLES = [name for name, blocks in PYTHON.items() if blocks and name not in ELSEWHERE and name not in ALONE]

# what a sample is run with in place of what it says: the same in fewer steps, of fewer environments, and of smaller batches; and a
# committed policy in the place of a run's
SHORTER = (
    (r"\.learn\([\d_]+\)", ".learn(1)"),
    (r'(make_sb3_vec_env\("[\w-]+", num_envs=)\d+', r"\g<1>2"),
    (r"n_steps=\d+", "n_steps=20"),
    (r"batch_size=\d+", "batch_size=40"),
    (r"n_eval_episodes=\d+", "n_eval_episodes=2"),
    (r"len\(successes\) < \d+", "len(successes) < 2"),
    (r"\b64\b", "4"),
    (r"default_rng\(0\), 12,", "default_rng(0), 2,"),
    (r"num_envs=16\b", "num_envs=4"),
    (r"for frame in range\(60\)", "for frame in range(4)"),
    (r"\[ball\]\] \* 60", "[ball]] * 4"),
    (r"\.step\(60\)", ".step(4)"),
    (r"steps=60", "steps=4"),
    (r'"runs/[^"]*policy.npz"', repr(str(next((ROOT / "clothgym" / "policies").glob("ClothReach-v0_*.npz"))))),
)


def run(page, blocks):
    """Execute a page's blocks one after the other, as somebody does who reads it."""
    names = {"__name__": "__main__"}
    for block in blocks:
        for long, short in SHORTER:
            block = re.sub(long, short, block)
        exec(compile(block, page, "exec"), names)
    return names


@pytest.mark.parametrize("page", SAMPLES)
def test_samples_of_a_page_run(page, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    run(page, PYTHON[page])


@pytest.mark.parametrize(("page", "number"), [(page, number) for page in ALONE for number in range(len(PYTHON[page]))])
def test_a_block_runs_by_itself(page, number, tmp_path, monkeypatch, capsys):
    """In an empty folder, without the names of another block, and without ids that only another one has registered."""
    monkeypatch.chdir(tmp_path)
    block, known = PYTHON[page][number], dict(gym.registry)
    for env_id in known:
        if env_id.startswith("Cloth") and not re.search(r"^(import|from) clothgym|clothgym:", block, re.MULTILINE):
            monkeypatch.delitem(gym.registry, env_id)
    try:
        names = run(page, [block])
    finally:
        for env_id in set(gym.registry) - set(known):
            del gym.registry[env_id]
    if page == "docs/howto/task.md":  # it is the whole of a task: its expert gets there
        task = names["envs"].unwrapped.task
        middle = task.simulation.positions[:, 40, :2]  # of 9 x 9 particles
        assert names["terminated"].all() and abs(middle - task.episode["goal"]).max() < 0.05
    if page == "README.md":
        assert {0: "policy", 1: "held_out", 2: "film", 3: "post"}[number] in names
        if number == 0:
            assert names["terminated"] and names["info"]["normalized_performance"] > 0.5  # the expert's
        if number == 1:
            assert (tmp_path / "reach.zip").exists() and "return, mean and standard deviation" in capsys.readouterr().out
        if number == 2:
            assert names["images"].shape[1:] == (48, 48, 1) and names["state"].shape[1:] == (68,)


@pytest.mark.parametrize("page", API, ids=lambda page: page.name)
def test_doctests_of_the_reference(page):
    text = page.read_text()
    test = doctest.DocTestParser().get_doctest(text, {}, page.name, str(page), 0)
    out = io.StringIO()
    outcome = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(test, out=out.write)
    assert outcome.failed == 0, out.getvalue()
    assert outcome.attempted == len(re.findall(r"^>>> ", text, re.MULTILINE))


def test_the_reference_has_every_public_name():
    text = "\n".join(page.read_text() for page in API)
    described = set(re.findall(r"^(?:\.\. [\w:]+::| +)\s*clothgym\.([\w.]+)", text, re.MULTILINE))
    public = (
        set(clothgym._HOMES)
        | {f"envs.{name}" for name in clothgym.envs.__all__}
        | {f"render.{name}" for name in clothgym.render.__all__}
    )
    public |= {f"policies.{name}" for name in ("load", "available", "read", "Policy")} | {
        f"adapters.{name}" for name in ("sb3.make_sb3_vec_env", "lagrange.LagrangianPPO", "pixels.DepthPolicy")
    }
    assert public <= described, sorted(public - described)
    for env_id, (name, _) in ENVIRONMENTS.items():
        assert f"clothgym.envs.{name}Env(" in text and f"</tasks/{env_id}>" in text


# --- commands ---------------------------------------------------------------------------------------------------------------


def commands(text):
    """What is typed: lines of blocks that are no program, and code within sentences, which may go on in the next line."""
    blocks = [
        line
        for language, block in re.findall(r"^```(\w*)\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
        if not language
        for line in block.splitlines()
    ]
    rest = re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)
    indented = re.findall(r"^    (\S.*)$", rest, re.MULTILINE)
    spans = [" ".join(span.split()) for span in re.findall(r"(?<!`)`([^`]+)`(?!`)", rest)]
    return [re.split(r"\s#\s|\s{2,}#", line)[0].strip() for line in blocks + indented + spans]


TYPED = sorted({(name, line) for name, page in PAGES.items() for line in commands(page)})
STARTED = [(name, line) for name, line in TYPED if re.match(r"python (-m clothgym|(training|benchmarks|docs)/)", line)]


@pytest.fixture(scope="module")
def help_of():
    """What a program answers to ``--help``; each is asked once, in this process."""
    known = {}

    def ask(program):
        if program not in known:
            said, before, path, argv = io.StringIO(), set(sys.modules), list(sys.path), list(sys.argv)
            try:
                with contextlib.redirect_stdout(said), contextlib.suppress(SystemExit):
                    if program[0] == "clothgym":
                        cli.main([*program[1:], "--help"])
                    else:
                        sys.argv = [program[0], "--help"]
                        sys.path.insert(0, str((ROOT / program[0]).parent))
                        runpy.run_path(str(ROOT / program[0]), run_name="__main__")
            except ModuleNotFoundError:  # a library that is not here: what its source says
                source = (ROOT / program[0]).read_text()
                said.write(
                    source + "".join(f" --{name.replace('_', '-')}" for name in re.findall(r"^    (\w+): ", source, re.MULTILINE))
                )
            finally:
                sys.path[:], sys.argv[:] = path, argv
                for name in set(sys.modules) - before:  # scripts of several folders have the same names
                    if Path(getattr(sys.modules[name], "__file__", None) or "/").parent in (
                        ROOT / "training",
                        ROOT / "benchmarks",
                        ROOT / "docs",
                    ):
                        del sys.modules[name]
            known[program] = set(re.findall(r"--[a-z][\w-]*", said.getvalue()))
        return known[program]

    return ask


def test_commands_are_found_and_take_their_options(help_of):
    assert len(STARTED) > 60
    wrong = []
    for page, line in STARTED:
        _, *words = shlex.split(line.replace("'", ""))
        program = ("clothgym", *[word for word in words[2:3] if word[0] != "-"]) if words[0] == "-m" else (words[0],)
        if words[0] != "-m" and not (ROOT / words[0]).is_file():
            wrong.append(f"{page}: {line}: there is no {words[0]}")
            continue
        wrong += [
            f"{page}: {line}: no {word}" for word in words if word.startswith("--") and word.split("=")[0] not in help_of(program)
        ]
    assert not wrong, "\n".join(wrong)


def test_targets_and_extras_exist():
    targets = set(re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    extras = set(tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"])
    for page, line in TYPED:
        if made := re.match(r"make (\w+)", line):
            assert made[1] in targets, f"{page}: {line}"
        if install := re.match(r"pip install .*\[([\w,]+)\]", line):
            assert set(install[1].split(",")) <= extras | {"create"}, f"{page}: {line}"


def test_every_id_that_is_named_exists():
    assert all((ROOT / "tests" / place).exists() for place in ELSEWHERE.values())
    for name, page in PAGES.items():
        assert set(re.findall(r"\bCloth[A-Z]\w+(?:-Hard)?-v\d+", page)) <= set(ENVIRONMENTS), name


def test_python_samples_are_marked_as_python():
    for name, blocks in BLOCKS.items():
        for language, text in () if name in ELSEWHERE else blocks:
            assert language or not re.search(r"^(import|from|env|def|class) ?\b.*", text, re.MULTILINE), f"{name}: {text}"
