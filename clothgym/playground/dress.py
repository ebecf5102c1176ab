"""The page's own title and icon, and its panel closed on a phone: viser offers no door for these."""

from __future__ import annotations

import gzip
import re
from functools import lru_cache
from typing import Any
from urllib.parse import quote

TITLE = "clothgym"
# a corner of gingham, which hangs from a pin
ICON = """<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 32 32'><g fill='#ce4032'><path d='M4 6h24v20q-6 4-12 0t-12 1z'/></g>
<g fill='#f7e4ce' opacity='.55'><path d='M10 6h6v20l-6 1z'/><path d='M22 6h6v20l-6 1z'/><path d='M4 12h24v6H4z'/></g>
<g fill='#fac83c'><circle cx='5' cy='6' r='4'/><circle cx='27' cy='6' r='4'/></g></svg>"""
NARROW = 576  # width of a window [pixels] up to which the controls lie over the sheet
# the panel at the bottom of a narrow window is open at first: close it once
CLOSING = """<script>if (innerWidth < NARROW) new MutationObserver((_, watch) => {
  const handle = document.querySelector('[style*="bottom: 0"] [style*="cursor: pointer"]');
  if (handle) { watch.disconnect(); handle.click(); }
}).observe(document, {childList: true, subtree: true});</script>""".replace("NARROW", str(NARROW))


def dressed(response: Any) -> None:
    """Change viser's page in an answer of its server, if it is that page."""
    if not response.headers.get("Content-Type", "").startswith("text/html"):
        return
    packed = response.headers.get("Content-Encoding") == "gzip"
    response.body = _page(response.body, packed)
    del response.headers["Content-Length"]
    response.headers["Content-Length"] = str(len(response.body))


@lru_cache(maxsize=4)
def _page(body: bytes, packed: bool) -> bytes:
    """The page, packed as it came; it is large, so it is made once."""
    page = (gzip.decompress(body) if packed else body).decode()
    page = re.sub(r"<title>.*?</title>", f"<title>{TITLE}</title>{CLOSING}", page, count=1)
    page = re.sub(r'(rel="icon"\s+href=)"[^"]*"', rf'\1"data:image/svg+xml,{quote(ICON)}"', page, count=1)
    return gzip.compress(page.encode(), 6) if packed else page.encode()
