"""The page's HTTP side: its document with the headers that isolate it, and how a browser brings the API key."""

import base64
import binascii
import hashlib
import re
from collections.abc import Sequence
from functools import cache
from pathlib import Path

from websockets.http11 import Request
from websockets.server import ServerProtocol
from websockets.typing import Subprotocol

PAGE, FEED = "/", "/live"
SUBPROTOCOL = Subprotocol("turbopi-live")
_KEY = "key."  # before the API key, as another subprotocol: a page can't set headers of a websocket
_NO_KEY, _NEEDS_KEY = 'data-key="no"', 'data-key="needed"'


def path_of(request: Request) -> str:
    """The request's path, without what follows a question mark."""
    return request.path.partition("?")[0]


def is_feed(request: Request | None) -> bool:
    """Whether it requests the feed."""
    return request is not None and path_of(request) == FEED


def is_page(request: Request) -> bool:
    """Whether it requests the document: a robot that connects to the same path wants to become a websocket."""
    return path_of(request) == PAGE and not request.headers.get_all("Upgrade")


def page_key(request: Request) -> str | None:
    """The API key that the page's script sends: base64url of it, behind "key.", among the subprotocols."""
    for header in request.headers.get_all("Sec-WebSocket-Protocol"):
        for offered in header.split(","):
            if offered.strip().startswith(_KEY):
                code = offered.strip().removeprefix(_KEY)
                try:
                    return base64.urlsafe_b64decode(code + "=" * (-len(code) % 4)).decode("ascii")
                except (binascii.Error, UnicodeDecodeError, ValueError):
                    return None
    return None


def select_subprotocol(_: ServerProtocol, offered: Sequence[Subprotocol]) -> Subprotocol | None:
    """The page's, if it is offered. Robots offer none, and get none."""
    return SUBPROTOCOL if SUBPROTOCOL in offered else None


@cache
def document(*, needs_key: bool) -> tuple[dict[str, str], str]:
    """Headers and body of the page. It holds nothing of the robots', so it needs no key itself."""
    body = (Path(__file__).parent / "page.html").read_text(encoding="utf-8")
    style, script = (_hash(body, tag) for tag in ("style", "script"))
    policy = (
        f"default-src 'none'; style-src '{style}'; script-src '{script}'; img-src data:; connect-src 'self'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )
    assert body.count(_NO_KEY) == 1
    body = body.replace(_NO_KEY, _NEEDS_KEY) if needs_key else body
    headers = {
        "Content-Type": "text/html; charset=utf-8",
        "Content-Security-Policy": policy,
        "Cross-Origin-Resource-Policy": "same-origin",
        "X-Content-Type-Options": "nosniff",
        "Referrer-Policy": "no-referrer",
        "Cache-Control": "no-store",
    }
    return headers, body


def _hash(body: str, tag: str) -> str:
    """What a Content-Security-Policy calls the content of the document's one element of that name."""
    (content,) = re.findall(f"<{tag}>(.*?)</{tag}>", body, re.DOTALL)
    return "sha256-" + base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()
