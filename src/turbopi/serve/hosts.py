"""Under which names this server may be addressed by web pages.

A browser lets any page open a websocket to any address, 127.0.0.1 too, and only says, in `Origin`, which page it is.
Pages of other origins are refused for that. What is left is DNS rebinding: a page of `evil.example:8000` whose name
suddenly resolves to 127.0.0.1 is of the server's own origin as far as the browser knows; Host and Origin both say
`evil.example:8000`. Only a list of the names that are really the server's tells it apart. An address instead of a name
can't be rebound, so any address is good.

Some clients that are no browsers send `Origin`, too: PyPI's websocket-client always sends the address it connects to.
The headers of a browser's handshake are the browser's: a page can neither leave one out nor change one. So a request
without any of those that browsers send is no page's.
"""

import ipaddress
import socket
from collections.abc import Iterable, Sequence
from urllib.parse import SplitResult, urlsplit

from turbopi.support.errors import ConfigError

LOOPBACK = ("127.0.0.1", "::1", "localhost")
# What browsers add to a websocket's handshake: each of them several, and a page chooses none of them.
_BROWSERS_HEADERS = frozenset(
    (
        *("user-agent", "accept-encoding", "accept-language", "sec-websocket-extensions", "cache-control", "pragma"),
        *("accept", "cookie", "dnt", "referer"),
    )
)
_BROWSERS_BEGINNINGS = ("sec-fetch-", "sec-ch-", "sec-gpc")


class AllowedHosts:
    """The names that a request's Host may have.

    host    what the server listens on; a name is allowed. Unless it is loopback, so are the machine's own names
    more    further names, without port; "*" is any name

    `localhost` and every IP address are always allowed. Raises ConfigError for what is no name.
    """

    def __init__(self, host: str, more: Sequence[str] = ()) -> None:
        for name in more:
            if not name or any(character in name for character in "/@:[] \t\n") or not name.isprintable():
                raise ConfigError(
                    f"allowed_hosts= has {name!r}, which is no name; give names such as robot.lab, without http:// and "
                    "without port"
                )
        self._named = {_plain(name) for name in more}
        self._any = "*" in self._named
        self._names = {"localhost", _plain(host), *self._named}
        self._beyond = host not in LOOPBACK
        if self._beyond:
            own = _plain(socket.gethostname())
            self._names |= {own, own.partition(".")[0], own.partition(".")[0] + ".local"}

    def has(self, host: str) -> bool:
        """Whether a Host header, a name or an address with or without port, is one of them."""
        try:
            name = urlsplit(f"//{host}").hostname
        except ValueError:  # "[::1"
            return False
        if name is None or "@" in host or "/" in host:
            return False
        return self._any or _is_address(name) or _plain(name) in self._names

    def lets_in(self, origin: str, host: str, headers: Iterable[str]) -> bool:
        """Whether a websocket's request with an Origin may come in: a page of `has_page`, or certainly no page.

        headers  the names of all of the request's headers

        No page is what names itself, as websocket-client does, and has no header that browsers send. That holds where
        the server listens beyond this machine: on loopback another name than localhost is the sign of a rebound one.
        """
        if self.has_page(origin, host):
            return True
        page, names = _page(origin), [name.lower() for name in headers]
        if not self._beyond or page is None or page.netloc.lower() != host.lower():
            return False
        return not any(name in _BROWSERS_HEADERS or name.startswith(_BROWSERS_BEGINNINGS) for name in names)

    def has_page(self, origin: str, host: str) -> bool:
        """Whether a page of `origin` may use the server as `host`.

        The server's own pages may (no other port of the same machine: other programs serve there), and those of hosts
        that were named.
        """
        page = _page(origin)
        if page is None or not self.has(host):
            return False
        return page.netloc.lower() == host.lower() or self._any or _plain(page.hostname or "") in self._named


def _page(origin: str) -> SplitResult | None:
    """An Origin that is a web page's address; None: it is none."""
    try:
        page = urlsplit(origin)
        return page if page.hostname is not None and page.scheme in ("http", "https") else None
    except ValueError:  # "http://[::1"
        return None


def _plain(name: str) -> str:
    return name.strip("[]").lower().removesuffix(".")


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name.partition("%")[0])
    except ValueError:
        return False
    return True
