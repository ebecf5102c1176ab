"""Check the site that ``make site`` has built: every link, and with ``--pictures`` every page in a browser.

python docs/check_site.py build/site
python docs/check_site.py build/site --pictures runs/site

Without network.  Links are followed in the files, to pages, pictures and headings, and nothing but links may lead to another host.
With ``--pictures``, which needs playwright and Chromium, each page is opened at two widths from a server on loopback: no error may
be told, no request may fail or leave this machine, each picture must be shown, and nothing may be wider than a phone.
"""

from __future__ import annotations

import argparse
import functools
import http.server
import shutil
import sys
import threading
import urllib.parse
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

WIDTHS = {"wide": (1280, 800), "phone": (390, 844)}
FLAGS = [
    "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
]  # fmt: skip
BROWSERS = "chromium", "chromium-browser", "google-chrome"
BROKEN = "[...document.images].filter(i => i.src && (!i.complete || !i.naturalWidth)).map(i => i.src)"
TOO_WIDE = "document.documentElement.scrollWidth - document.documentElement.clientWidth"


class Page(HTMLParser):
    """A page's anchors, the links of its text, and what it loads."""

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


def look(site: Path, pictures: Path) -> list[str]:
    """Open all pages in Chromium, and keep a picture of each; what is wrong with them, a sentence each."""
    from playwright.sync_api import sync_playwright

    browser_path = next((path for path in map(shutil.which, BROWSERS) if path), None)
    if browser_path is None:
        raise SystemExit("error: --pictures needs Chromium: apt-get install chromium")
    handler = functools.partial(Quiet, directory=str(site))
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    home, wrong = f"http://127.0.0.1:{server.server_port}/", []
    pages = sorted(path.relative_to(site) for path in site.rglob("*.html"))
    try:
        with sync_playwright() as driver:
            browser = driver.chromium.launch(executable_path=browser_path, args=FLAGS)
            for width, (across, down) in WIDTHS.items():
                tab = browser.new_page(viewport={"width": across, "height": down})
                # what lies elsewhere is not fetched, and told
                tab.route(lambda url: not url.startswith((home, "data:", "blob:")), lambda route: route.abort())
                said: list[str] = []
                listen(tab, home, said)
                for page in pages:
                    said.clear()
                    tab.goto(home + page.as_posix(), wait_until="load")
                    # pictures are loaded when they come into view
                    tab.evaluate("for (const i of document.images) i.loading = 'eager'")
                    tab.wait_for_function("[...document.images].every(picture => picture.complete)")
                    said += [f"{picture} is not shown" for picture in tab.evaluate(BROKEN)]
                    beyond = tab.evaluate(TOO_WIDE)
                    said += [f"{beyond} pixels wider than its window"] if beyond > 0 else []
                    wrong += [f"{page} ({width}): {what}" for what in said]
                    tab.screenshot(path=pictures / f"{page.with_suffix('').as_posix().replace('/', '_')}_{width}.png")
                tab.close()
            browser.close()
    finally:
        server.shutdown()
        server.server_close()
    print(f"{len(pages)} pages at {len(WIDTHS)} widths, pictures in {pictures}")
    return wrong


def listen(tab: Any, home: str, said: list[str]) -> None:
    """Collect what a tab complains of, and each request that fails or goes elsewhere."""
    tab.on("console", lambda message: said.append(f"says {message.text}") if message.type in ("error", "warning") else None)
    tab.on("pageerror", lambda error: said.append(f"fails with {error}"))
    tab.on("requestfailed", lambda request: said.append(f"{request.url} could not be loaded"))
    tab.on("response", lambda answer: said.append(f"{answer.url} is answered by {answer.status}") if answer.status >= 400 else None)
    tab.on(
        "request", lambda request: None if request.url.startswith((home, "data:", "blob:")) else said.append(f"asks {request.url}")
    )


class Quiet(http.server.SimpleHTTPRequestHandler):
    """A server of files that does not print each request."""

    def log_message(self, *_: Any) -> None:
        pass


def main() -> None:
    parser = argparse.ArgumentParser(description="Check a built site: its links, and with --pictures its pages in a browser.")
    parser.add_argument("site", type=Path, help="its folder, build/site")
    parser.add_argument("--pictures", type=Path, metavar="DIR", help="open each page in Chromium, and keep pictures of all there")
    options = parser.parse_args()
    if not (options.site / "index.html").is_file():
        parser.error(f"{options.site}: there is no index.html, build it first with  make site")
    wrong = dead_links(options.site)
    if options.pictures:
        options.pictures.mkdir(parents=True, exist_ok=True)
        wrong += look(options.site, options.pictures)
    if wrong:
        sys.exit("\n".join(wrong))
    print("every link leads somewhere")


if __name__ == "__main__":
    main()
