"""Check the links of the site that ``make site`` has built:  python docs/check_site.py build/site

Links are followed in the files, to pages, pictures and headings.  Nothing but links may lead to another host.
"""

from __future__ import annotations

import argparse
import sys
import urllib.parse
from html.parser import HTMLParser
from pathlib import Path


class Page(HTMLParser):
    """A page's anchors, the links of its text, and its loaded files."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.anchors: set[str] = set()
        self.links: set[str] = set()
        self.loaded: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attrs}
        self.anchors |= {given[name] for name in ("id", "name") if name in given}
        if tag == "a" and "href" in given:
            self.links.add(given["href"])
        self.loaded |= {given["src"]} if "src" in given else set()
        self.loaded |= {given["href"]} if tag == "link" and "href" in given else set()


def dead_links(site: Path) -> list[str]:
    """What leads nowhere, and what would be loaded from elsewhere, a sentence each."""
    pages = {path.resolve(): Page(path.read_text()) for path in sorted(site.rglob("*.html"))}
    wrong = []
    for path, page in pages.items():
        name = path.relative_to(site.resolve())
        for link in sorted(page.links | page.loaded):
            parts = urllib.parse.urlsplit(link)
            if parts.scheme == "data":
                continue
            if parts.scheme or parts.netloc:
                wrong += [f"{name}: loads {link}"] if link in page.loaded else []
                continue
            target = (path.parent / urllib.parse.unquote(parts.path)).resolve() if parts.path else path
            target = target / "index.html" if target.is_dir() else target
            if not target.is_file():
                wrong.append(f"{name}: {link} does not exist")
            elif parts.fragment and target in pages and parts.fragment not in pages[target].anchors:
                wrong.append(f"{name}: {link} has no such place")
    return wrong


def main() -> None:
    parser = argparse.ArgumentParser(description="Check the links of a built site.")
    parser.add_argument("site", type=Path, help="its folder, build/site")
    options = parser.parse_args()
    if not (options.site / "index.html").is_file():
        parser.error(f"{options.site}: there is no index.html, build it first with  make site")
    wrong = dead_links(options.site)
    if wrong:
        sys.exit("\n".join(wrong))
    print("every link leads somewhere")


if __name__ == "__main__":
    main()
