"""Under which names this server may be addressed by web pages.

A browser lets any page open a websocket to any address, 127.0.0.1 too, and only says, in `Origin`, which page it is.
Pages of other origins are refused for that. What is left is DNS rebinding: a page of `evil.example:8000` whose name
suddenly resolves to 127.0.0.1 is of the server's own origin as far as the browser knows; Host and Origin both say
`evil.example:8000`. Only a list of the names that are really the server's tells it apart. An address instead of a name
can't be rebound, so any address is good.
"""

import ipaddress
import socket
from collections.abc import Sequence
from urllib.parse import urlsplit

from turbopi.errors import ConfigError

LOOPBACK = ("127.0.0.1", "::1", "localhost")


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
        if host not in LOOPBACK:
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

    def has_page(self, origin: str, host: str) -> bool:
        """Whether a page of `origin` may use the server as `host`.

        The server's own pages may (no other port of the same machine: other programs serve there), and those of hosts
        that were named.
        """
        try:
            page = urlsplit(origin)
            name = page.hostname
        except ValueError:
            return False
        if name is None or page.scheme not in ("http", "https") or not self.has(host):
            return False
        return page.netloc.lower() == host.lower() or self._any or _plain(name) in self._named


def _plain(name: str) -> str:
    return name.strip("[]").lower().removesuffix(".")


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name.partition("%")[0])
    except ValueError:
        return False
    return True
