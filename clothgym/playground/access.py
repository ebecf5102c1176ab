"""Who may visit: every request to the playground's server passes here first.

Any page in the visitor's browser can send requests to this machine.  So the ``Host`` of a request must be this server: a page
whose name has been rebound to this address sends its own name.  And the ``Origin``, which browsers send with every websocket, must
be this server's page.  A program other than a browser sends no ``Origin``, and no page can make it visit.  Beyond loopback a
request also needs the token of the printed address, in its own address or in the cookie that the page has set.
"""

from __future__ import annotations

import contextlib
import hmac
import http
import ipaddress
import secrets
import socket
from collections.abc import Callable
from typing import Any
from urllib.parse import parse_qs, urlsplit

from clothgym.checks import shown

MOST_VISITS = 16
PAGES = ("/", "/index.html")
MALFORMED = http.HTTPStatus.BAD_REQUEST, "This request is malformed."
FRAMES = "frame-ancestors 'self' http://localhost:* http://127.0.0.1:*"  # notebooks on this machine may embed the page
EVERYWHERE = {"": "127.0.0.1", "0.0.0.0": "127.0.0.1", "::": "::1"}  # how this machine reaches a server at all its addresses


class Access:
    """The guard of one server.

    Args:
        host: address that the server listens at.
        port: its port.
        full: whether there is no room for one more visitor, given so many open websockets.

    Attributes:
        token: that a request must bring; "" on loopback, where only this machine's programs can send one.
    """

    def __init__(self, host: str, port: int, full: Callable[[int], bool] = lambda connections: False) -> None:
        self.host, self.port, self._full = host, port, full
        self.token = "" if is_loopback(host) else secrets.token_urlsafe(24)

    @property
    def url(self) -> str:
        """Where the page is: the address to open."""
        return f"http://{_named(reachable(self.host))}:{self.port}" + (f"/?token={self.token}" if self.token else "")

    def refusal(self, path: str, headers: Any, connections: int = 0) -> tuple[http.HTTPStatus, str] | None:
        """Why a request is refused, None if it may pass; path: with its query; headers: of websockets; connections: open now.

        No answer holds the token.

        Raises:
            ValueError, LookupError: a malformed address, or a header twice.
        """
        hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
        # rebound names; beyond loopback a server has names that it does not know, and the token guards it
        if len(hosts) != 1:
            return MALFORMED
        if not self.token and hosts[0].lower() not in self._own_names():
            return http.HTTPStatus.FORBIDDEN, f"This server is not {shown(hosts[0])}: open {self.url}"
        if origins and (len(origins) > 1 or not _is_page_of(origins[0], hosts[0])):
            return http.HTTPStatus.FORBIDDEN, f"A page of {shown(origins)} may not visit this server."
        if self.token and not self._has_token(path, headers):
            return http.HTTPStatus.FORBIDDEN, "Open the whole address that the server has printed, with its token."
        entering = headers.get("Upgrade") is not None or urlsplit(path).path in PAGES
        if entering and self._full(connections):
            return http.HTTPStatus.SERVICE_UNAVAILABLE, f"The playground is full, with {MOST_VISITS} visitors. Try again later."
        return None

    def guarded(self, process: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
        """A websocket server's ``process_request`` that refuses first, and then does as before."""

        def process_request(connection: Any, request: Any) -> Any:
            try:
                refused = self.refusal(request.path, request.headers, len(connection.server.connections))
            except (ValueError, LookupError):
                refused = MALFORMED
            if refused is not None:
                return connection.respond(refused[0], refused[1] + "\n")
            response = process(connection, request)
            if response is not None:
                response.headers["Content-Security-Policy"] = FRAMES
                response.headers["Referrer-Policy"] = "no-referrer"
                if self.token:
                    response.headers["Set-Cookie"] = f"{self._cookie}={self.token}; HttpOnly; SameSite=Strict; Path=/"
            return response

        return process_request

    @property
    def _cookie(self) -> str:
        return f"clothgym-{self.port}"

    def _own_names(self) -> set[str]:
        names = {"localhost", "127.0.0.1", "[::1]", _named(self.host).lower()}
        return {f"{name}:{self.port}" for name in names} | (names if self.port == 80 else set())

    def _has_token(self, path: str, headers: Any) -> bool:
        offered = parse_qs(urlsplit(path).query).get("token", []) + in_cookies(headers, self._cookie)
        return any(hmac.compare_digest(one.encode(), self.token.encode()) for one in offered)


def in_cookies(headers: Any, wanted: str) -> list[str]:
    """The values that a request's cookies have for a name."""
    pairs = [part.strip().partition("=") for header in headers.get_all("Cookie") for part in header.split(";")]
    return [value for name, _, value in pairs if name == wanted]


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach that address."""
    with contextlib.suppress(ValueError):
        return ipaddress.ip_address(host).is_loopback
    return host == "localhost"


def reachable(host: str) -> str:
    """An address under which others reach a server that listens at ``host``: this machine's own for all of its addresses."""
    if host not in EVERYWHERE:
        return host
    family, beyond = (socket.AF_INET6, "2001:db8::1") if host == "::" else (socket.AF_INET, "192.0.2.1")
    # nothing is sent: a datagram socket that is connected knows the address that it would send from
    with contextlib.suppress(OSError), socket.socket(family, socket.SOCK_DGRAM) as probe:
        probe.connect((beyond, 9))
        return str(probe.getsockname()[0])
    return EVERYWHERE[host]


def _named(host: str) -> str:
    """A host as addresses write it."""
    return f"[{host}]" if ":" in host else host


def _is_page_of(origin: str, host: str) -> bool:
    """Whether an ``Origin`` is that of a page of this ``Host``."""
    parts = urlsplit(origin)
    return parts.scheme in ("http", "https") and parts.netloc.lower() == host.lower()
