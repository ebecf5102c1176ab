"""How Sphinx makes the site of these pages and of the docstrings.  ``make site`` builds it into build/site, without network.

The pages are read as they are, and their links lead to the same places on GitHub and on the site.  What Sphinx cannot know is
below: which pages are files of the repository's root, and what the command line answers to ``--help``.
"""

from __future__ import annotations

import argparse
import functools
import re
import shutil
from pathlib import Path
from typing import Any

import clothgym
from clothgym import cli
from clothgym.registration import ENVIRONMENTS

HERE = Path(__file__).parent
ROOT = HERE.parent

project, author, copyright = "clothgym", "clothgym contributors", "clothgym contributors"
version = release = clothgym.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_copybutton"]
nitpicky = True
exclude_patterns = ["demo"]
highlight_language = "none"  # a block without a language is shell input

# pages in Markdown: anchors of headings as GitHub makes them
myst_heading_anchors = 4
myst_links_external_new_tab = False

# docstrings: their Args and Attributes, and types as they are written
autodoc_mock_imports = ["torch", "stable_baselines3"]
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_type_aliases = {name: name for name in ("ArrayLike", "NDArray", "Drawable", "Shape", "Color", "Held")}
autodoc_preserve_defaults = True
maximum_signature_line_length = 80
autodoc_inherit_docstrings = False  # those of Gymnasium and NumPy are on their own pages
napoleon_numpy_docstring = False
napoleon_use_ivar = True
nitpick_ignore_regex = [("py:class", ".*"), ("py:exc", r"gymnasium\..*")]  # no page of another project is fetched to link them

html_theme = "furo"
html_title = "clothgym"
html_favicon = "theme/icon.svg"
html_static_path = ["theme"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sphinx = False
html_theme_options: dict[str, Any] = {
    "light_css_variables": {"color-brand-primary": "#a8322d", "color-brand-content": "#a8322d"},
    "dark_css_variables": {"color-brand-primary": "#f0958c", "color-brand-content": "#f0958c"},
}

# pages of the site that are files of the root; in docs/ a line stands in their place
OF_THE_ROOT = {"about/changelog": "CHANGELOG.md", "about/contributing": "CONTRIBUTING.md"}
DEMO = HERE / "demo" / "index.html"
SHARED = "../../clothgym/playground/web"  # with the playground's page; in the demo's own folder on the site
LINK_TO_DEMO = '<a class="demo" href="demo/index.html">Take hold of a sheet, in your browser</a>'


def prepare(app: Any, page: str, source: list[str]) -> None:
    """Insert a page's text from elsewhere in the repository, and convert its links to links on the site."""
    text = source[0]
    folders = "../" * page.count("/")
    if page in OF_THE_ROOT:
        text = (ROOT / OF_THE_ROOT[page]).read_text()
        text = re.sub(r"\]\((?!\w+:|#)", f"]({folders}../", text)
    text = re.sub(r"\]\((?:\.\./)+docs/", f"]({folders}", text)
    for place, name in {**OF_THE_ROOT, "index": "README.md"}.items():
        text = re.sub(rf"\]\({folders}\.\./{re.escape(name)}(#[\w-]+)?\)", f"]({folders}{place}.md)", text)
    if page == "peers":
        readme = (ROOT / "README.md").read_text()
        table = re.search(r"^## Comparison with other learning benchmarks\n(.*?\n)\n[^|]", readme, re.DOTALL | re.MULTILINE)
        assert table, "README.md has no table of other projects"
        text = text.replace("\n## ", f"\n{table[1]}\n## ", 1)
    if page == "index" and DEMO.exists():
        text = text.replace("<!-- demo -->", LINK_TO_DEMO)
    if page == "tasks/README":
        text += "\n".join(["", "```{toctree}", ":hidden:", "", *ENVIRONMENTS, "```", ""])
    if page == "api/commands":
        text += help_of_commands()
    # the demo is a page that Sphinx does not know; folders and other texts of the repository are no pages
    text = re.sub(r"\[([^\]]+)\]\(((?:\.\./)*demo/index\.html)\)", r'<a href="\2">\1</a>', text)
    source[0] = re.sub(rf"\[([^\]]+)\]\({folders}\.\./[\w/]+(?:\.md)?\)", r"\1", text)


def help_of_commands() -> str:
    """What each command answers to ``--help``, in reStructuredText."""
    parser = cli._parser()
    parser.prog = "python -m clothgym"
    commands = next(action for action in parser._actions if isinstance(action, argparse._SubParsersAction)).choices
    parts = []
    for name, command in commands.items():
        command.prog = f"python -m clothgym {name}"
        command.formatter_class = functools.partial(argparse.HelpFormatter, width=90)
        lines = "\n".join(f"    {line}".rstrip() for line in command.format_help().splitlines())
        parts.append(f"\n{name}\n{'-' * len(name)}\n\n.. code-block:: none\n\n{lines}\n")
    return "".join(parts)


def take_demo(app: Any, error: Exception | None) -> None:
    """Copy the demo, which is a page of its own, with what it shares with the playground's page."""
    if error is None and app.builder.format == "html" and DEMO.exists():
        there = Path(app.outdir) / "demo"
        shutil.copytree(DEMO.parent, there, dirs_exist_ok=True, ignore=shutil.ignore_patterns("*.py", "*.md"))
        page = (there / DEMO.name).read_text()
        for name in re.findall(rf'"{re.escape(SHARED)}/([\w.]+)"', page):
            shutil.copy(DEMO.parent / SHARED / name, there)
        (there / DEMO.name).write_text(page.replace(f"{SHARED}/", ""))


def setup(app: Any) -> None:
    app.connect("source-read", prepare)
    app.connect("build-finished", take_demo)
