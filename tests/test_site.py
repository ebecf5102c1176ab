"""The site's checks find what is wrong with a site, and its pages are made of what is in the repository."""

import re
import subprocess
import sys
from types import SimpleNamespace

import pytest
from training_runs import ROOT

import clothgym.cli
from clothgym.registration import ENVIRONMENTS


@pytest.fixture
def scripts(monkeypatch):
    """docs/, to import from."""
    monkeypatch.syspath_prepend(str(ROOT / "docs"))


def test_dead_links_are_found(scripts, tmp_path):
    from check_site import dead_links

    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "index.html").write_text('<h1 id="top">There</h1><a href="../index.html#here">back</a>')
    (tmp_path / "index.html").write_text(
        '<link rel="icon" href="data:,"><p id="here"><a href="#here">a</a><a href="there">b</a><a href="there/index.html#top">c</a>'
        '<a href="https://elsewhere.example/">may be followed</a></p>'
    )
    assert dead_links(tmp_path) == []
    (tmp_path / "bad.html").write_text(
        '<a href="gone.html">1</a><a href="#gone">2</a><a href="there/#bottom">3</a><img src="gone.png">'
        '<link rel="stylesheet" href="https://elsewhere.example/font.css"><script src="//elsewhere.example/a.js"></script>'
    )
    assert dead_links(tmp_path) == [
        "bad.html: #gone has no such place",
        "bad.html: loads //elsewhere.example/a.js",
        "bad.html: gone.html does not exist",
        "bad.html: gone.png does not exist",
        "bad.html: loads https://elsewhere.example/font.css",
        "bad.html: there/#bottom has no such place",
    ]


def test_the_check_ends_with_an_error(tmp_path):
    (tmp_path / "index.html").write_text('<a href="gone.html">gone</a>')
    command = [sys.executable, ROOT / "docs" / "check_site.py", tmp_path]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 1 and ended.stderr == "index.html: gone.html does not exist\n"


def test_pages_have_what_is_elsewhere_in_the_repository(scripts, monkeypatch, tmp_path):
    import conf

    def prepared(page, text=None):
        source = [(ROOT / "docs" / f"{page}.md").read_text() if text is None else text]
        conf.prepare(None, page, source)
        return source[0]

    changelog = prepared("about/changelog")
    assert changelog.startswith("# Changelog\n\nThe form is") and "](../materials.md)" in changelog
    assert "](../about/changelog.md)" in prepared("about/contributing")
    assert "| runs on | CPU, **no GPU** |" in prepared("peers")
    assert all(f"\n{env_id}\n" in prepared("tasks/README") for env_id in ENVIRONMENTS)
    said = prepared("api/commands", "")
    assert all(f"\n{name}\n---" in said for name in ("view", "export", "bench")) and "--integrators NAME" in said
    # folders and other texts of the repository are no pages, files are downloads, and the demo is a page of its own
    links = "[a](../training/hyperparams) [b](../CITATION.cff) [c](../README.md#train) [d](../CODE.md)"
    assert prepared("learning", links) == "a [b](../CITATION.cff) [c](index.md) d"
    links = "[a](../demo/index.html) [b](../physics.md) [c](../../envs/drape.py)"
    assert prepared("tasks/x", links) == '<a href="../demo/index.html">a</a> [b](../physics.md) [c](../../envs/drape.py)'
    monkeypatch.setattr(conf, "DEMO", tmp_path / "index.html")
    (tmp_path / "index.html").touch()
    assert prepared("index", "<!-- demo -->") == conf.LINK_TO_DEMO


def test_the_demo_on_the_site_has_all_files_that_it_names_in_its_own_folder(scripts, tmp_path):
    import conf

    conf.take_demo(SimpleNamespace(builder=SimpleNamespace(format="html"), outdir=tmp_path), None)
    page = (tmp_path / "demo" / "index.html").read_text()
    names = re.findall(r'(?:src|href|og:image" content)="([\w./-]+)"', page)
    assert {"viewer.js", "look.css", "cloth.js", "episodes/index.js", "card.jpg"} <= set(names)
    assert ".." not in " ".join(names) and not [name for name in names if not (tmp_path / "demo" / name).is_file()]


def test_the_commands_of_the_reference_are_all(scripts):
    import conf

    parser = clothgym.cli._parser()
    listed = next(action.choices for action in parser._actions if hasattr(action, "choices") and action.choices)
    assert len(listed) >= 6 and all(f"\n{name}\n" in conf.help_of_commands() for name in listed)
