"""The HTTP side of the port: health, metrics, the page, and who may become a websocket client."""

import hmac
import logging
from collections.abc import Callable, Mapping
from http import HTTPStatus

from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from turbopi.serve.hosts import AllowedHosts
from turbopi.serve.http_api import ACTIONS
from turbopi.serve.limited_log import LimitedLog, peer
from turbopi.serve.metrics import CONTENT_TYPE, Metrics
from turbopi.serve.options import check_key
from turbopi.serve.page.http import document, is_feed, is_page, page_key, path_of

logger = logging.getLogger(__name__)
WHAT_TO_SET = (
    "start the server with --allowed-hosts NAME (allowed_hosts= in Python), the host's name without port. A client "
    "that is no web page may leave Origin out instead (websocket-client: suppress_origin=True)."
)


class Gate:
    """Decides about each HTTP request on the server's port.

    api_key   with it, everything but `/healthz` and the page's document needs `Authorization: Api-Key <api_key>`; load
              balancers carry no key. The page lets its user type it, and sends it with the request for its feed
    hosts     the names by which web pages may address the server; the page and, without a key, `/metrics`, too
    has_page  whether the page and its feed are served
    why_lost  why no request can be served any more (the GPU failed for good), None while all is well: until the
              process ends, `/healthz` answers 503 with it, and so does every new client
    why_unwell
              why none can be served at the moment, None while all is well: `/healthz` alone answers 503 with it

    Raises ConfigError for a key that no header can carry.
    """

    def __init__(
        self,
        api_key: str | None,
        metrics: Metrics,
        hosts: AllowedHosts,
        why_lost: Callable[[], str | None] = lambda: None,
        why_unwell: Callable[[], str | None] = lambda: None,
        *,
        has_page: bool = False,
    ) -> None:
        check_key(api_key)
        self._key = None if api_key is None else api_key.encode()
        self._metrics, self._hosts, self._has_page = metrics, hosts, has_page
        self._why_lost, self._why_unwell = why_lost, why_unwell
        self._log = LimitedLog(logger)
        self.documents: dict[str, str] = {}  # JSON by path, once there is any

    def __call__(self, connection: ServerConnection, request: Request) -> Response | None:
        """The answer to a plain HTTP request, or None to go on with the websocket handshake."""
        if (refusal := _protocol_refusal(connection, request)) is not None:
            return refusal
        path, lost = path_of(request), self._why_lost()
        if len(request.headers.get_all("Host")) > 1:  # which of them a proxy has checked, nobody knows
            return connection.respond(HTTPStatus.BAD_REQUEST, "A request has one Host header.\n")
        if path == "/healthz":
            if lost is not None:
                return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, f"the device is lost: {lost}\n")
            if (unwell := self._why_unwell()) is not None:
                return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, f"{unwell}\n")
            return connection.respond(HTTPStatus.OK, "OK\n")
        if is_page(request) or is_feed(request):
            if not self._has_page:
                return connection.respond(HTTPStatus.NOT_FOUND, "The page is off; --page or an API key turns it on.\n")
            if is_page(request):
                return self._page(connection, request)
        if not self._authorized(request):
            return self._unauthorized(connection, request)
        if path == "/metrics":
            return self._document(connection, request, CONTENT_TYPE, self._metrics.text())
        if path in self.documents and not request.headers.get_all("Upgrade"):
            return self._document(connection, request, "application/json", self.documents[path])
        if path == ACTIONS and not request.headers.get_all("Upgrade"):
            response = connection.respond(HTTPStatus.METHOD_NOT_ALLOWED, f"POST an observation to {ACTIONS}.\n")
            response.headers["Allow"] = "POST"
            return response
        host = _only(request, "Host")
        for origin in request.headers.get_all("Origin"):  # of browsers, always; most robots send none
            if host is None or not self._hosts.lets_in(origin, host, request.headers):
                return self._forbidden(connection, f"pages of {_short(origin)} may not use {_short(host)}")
        if lost is not None:
            self._metrics.error("lost")
            return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, f"the device is lost: {lost}\n")
        return None

    def flush_log(self) -> None:
        """Say at the end how many lines of the log were left out and not said yet."""
        self._log.flush()

    def _document(self, connection: ServerConnection, request: Request, kind: str, text: str) -> Response:
        host = _only(request, "Host")
        if self._key is None and (host is None or not self._hosts.has(host)):
            # A page's GET of its own origin has no Origin, so a rebound name shows in Host alone
            return self._forbidden(connection, f"{path_of(request)} is not for {_short(host)}")
        return _found(connection, {"Content-Type": kind}, text)

    def _page(self, connection: ServerConnection, request: Request) -> Response:
        host = _only(request, "Host")
        if host is None or not self._hosts.has(host):
            return self._forbidden(connection, f"the page is not for {_short(host)}")
        return _found(connection, *document(needs_key=self._key is not None))

    def _forbidden(self, connection: ServerConnection, why: str) -> Response:
        self._metrics.error("origin")
        self._log.warning(f"{peer(connection)} refused: {why}")
        return connection.respond(HTTPStatus.FORBIDDEN, f"{why}: {WHAT_TO_SET}\n")

    def _unauthorized(self, connection: ServerConnection, request: Request) -> Response:
        self._metrics.error("unauthorized")
        sent = request.headers.get_all("Authorization") or (is_feed(request) and page_key(request))
        what = "a wrong API key" if sent else "no API key"
        self._log.warning(f"{peer(connection)} refused: it sent {what}")
        response = connection.respond(HTTPStatus.UNAUTHORIZED, "Send the header `Authorization: Api-Key <key>`.\n")
        response.headers["WWW-Authenticate"] = "Api-Key"
        return response

    def _authorized(self, request: Request) -> bool:
        if self._key is None:
            return True
        headers = request.headers.get_all("Authorization")
        scheme, _, key = headers[0].partition(" ") if len(headers) == 1 else ("", "", "")
        if is_feed(request) and not headers:
            scheme, key = "api-key", page_key(request) or ""
        given = key.strip().encode(errors="replace")
        return scheme.lower() == "api-key" and hmac.compare_digest(given, self._key)  # in constant time


def _protocol_refusal(connection: ServerConnection, request: Request) -> Response | None:
    """The answer to what isn't a GET of HTTP/1.1. websockets before 17 closes such a connection by itself."""
    method, version = getattr(request, "method", "GET"), getattr(request, "protocol", "HTTP/1.1")
    if method != "GET":
        response = connection.respond(HTTPStatus.METHOD_NOT_ALLOWED, f"This server answers GET, and POST {ACTIONS}.\n")
        response.headers["Allow"] = "GET"
        if method == "HEAD":
            response.body = b""
        return response
    if version != "HTTP/1.1":
        return connection.respond(HTTPStatus.HTTP_VERSION_NOT_SUPPORTED, "This server speaks HTTP/1.1 alone.\n")
    return None


def _found(connection: ServerConnection, headers: Mapping[str, str], text: str) -> Response:
    """`text` with these headers, a Content-Type among them."""
    response = connection.respond(HTTPStatus.OK, text)
    del response.headers["Content-Type"]  # a second one would be added, not put in its place
    response.headers.update(headers)
    return response


def _only(request: Request, name: str) -> str | None:
    """A header that should be there once; None if it isn't."""
    values = request.headers.get_all(name)
    return values[0] if len(values) == 1 else None


def _short(value: str | None) -> str:
    if value is None:
        return "a request without one Host"
    return repr(value if len(value) <= 80 else value[:80] + "…")
