"""The page names the versions that the tests run with, and has no script that none of them runs."""

import re

from page import PAGE, ROOT, SECTIONS, run, script

PACKAGES = {"RL Baselines3 Zoo": "rl_zoo3", "Stable-Baselines3": "stable_baselines3"}


def test_headings_name_the_versions_of_the_constraints():
    pinned = dict(re.findall(r"^([\w-]+)==(\S+)$", (ROOT / ".ci" / "clients.txt").read_text(), re.MULTILINE))
    headed = [match.groups() for name in SECTIONS if (match := re.fullmatch(r"(.+) (\d+\.\d+)", name))]
    assert len(headed) >= 6
    for library, version in headed:
        package = PACKAGES.get(library, library.lower())
        if package in pinned:
            assert pinned[package].startswith(version + "."), (library, version)


def test_every_script_is_run():
    tests = "".join(path.read_text() for path in (ROOT / "tests" / "clients").glob("test_*.py"))
    scripted = {name for name in SECTIONS if "```" in SECTIONS[name]}
    run_here = set(re.findall(r"(?:run|script)\(\"([^\"]+)\"\)", tests)) | {"By hand"}
    assert all(any(name.startswith(heading) for heading in run_here) for name in scripted), scripted
    assert PAGE.count("```") == 2 * len(scripted)


def test_planners_branch_a_state():
    names = run("Planners")
    assert names["observations"].shape == (64, names["env"].observation_space.shape[0])
    # one state, and then as many as there are actions
    assert len({float(reward) for reward in names["rewards"]}) > 60


def test_playing_by_hand(monkeypatch):
    """The script as it stands, in a window that closes at once."""
    import pytest

    pygame = pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    pygame.init()
    pygame.event.post(pygame.event.Event(pygame.QUIT))
    exec(compile(script("By hand"), "docs/clients.md", "exec"), {})
