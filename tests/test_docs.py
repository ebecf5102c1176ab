"""The pages: links lead somewhere, and tables name everything there is."""

import re
import tomllib
from pathlib import Path

import pytest
import yaml

import clothgym
from clothgym.registration import ENVIRONMENTS

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")])
TASKS = sorted((ROOT / "docs" / "tasks").glob("*.md"))
PICTURES = {".png", ".webp"}


def headings(text):
    """Anchors as GitHub makes them: lower case, hyphens for spaces, no other punctuation."""
    lines = re.findall(r"^#+ (.*)$", re.sub(r"```.*?```", "", text, flags=re.DOTALL), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", line.lower()).replace(" ", "-") for line in lines}


@pytest.mark.parametrize("page", [*PAGES, *TASKS], ids=lambda page: page.name)
def test_relative_links_resolve(page):
    links = [link for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text()) if "://" not in link]
    for link in links:
        path, _, anchor = link.partition("#")
        target = (page.parent / path) if path else page
        if target.suffix in PICTURES and not (ROOT / ".git").exists():
            continue  # an sdist has no pictures
        assert target.exists(), link
        assert target.resolve().is_relative_to(ROOT.resolve()), f"{link} leaves the repository"
        if anchor:
            assert anchor in headings(target.read_text()), link


def test_readme_is_one_sitting_and_names_everything():
    assert len(README.splitlines()) <= 150
    for name in (*ENVIRONMENTS, *clothgym.INTEGRATORS):
        assert f"`{name}`" in README, name
    assert [page.name for page in PAGES if f"]({page.relative_to(ROOT).as_posix()})" not in README] == ["README.md"]


def test_version_is_the_same_everywhere():
    """It is written in the package; pyproject.toml reads it there, and the other two follow by hand."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())
    project, version = settings["project"], clothgym.__version__
    assert project["dynamic"] == ["version"]
    assert settings["tool"]["setuptools"]["dynamic"] == {"version": {"attr": "clothgym.__version__"}}
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["cff-version"] == "1.2.0" and citation["license"] == project["license"] == "MIT"
    assert {"message", "title", "authors"} <= set(citation)
    assert str(citation["version"]) == version and citation["repository-code"] == project["urls"]["Homepage"]
    assert f"## [{version}] - " in (ROOT / "CHANGELOG.md").read_text()
