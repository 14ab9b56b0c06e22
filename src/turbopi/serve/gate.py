"""The HTTP side of the port: health, metrics, and who may become a websocket client."""

import hmac
from http import HTTPStatus
from urllib.parse import urlsplit

from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from turbopi.errors import ConfigError
from turbopi.serve.metrics import CONTENT_TYPE, Metrics


def check_key(api_key: str | None) -> None:
    """Raise ConfigError for a key that no header can carry."""
    if api_key is not None and not (api_key and api_key.isascii() and api_key.isprintable() and " " not in api_key):
        raise ConfigError("the API key must be printable ASCII without spaces, and not empty")


class Gate:
    """Decides about each HTTP request on the server's port.

    `/healthz` is open to all: load balancers carry no key. With an `api_key`, everything else needs
    `Authorization: Api-Key <api_key>`, `/metrics` too. Raises ConfigError for a key that no header can carry.
    """

    def __init__(self, api_key: str | None, metrics: Metrics) -> None:
        check_key(api_key)
        self._key = None if api_key is None else api_key.encode()
        self._metrics = metrics

    def __call__(self, connection: ServerConnection, request: Request) -> Response | None:
        """The answer to a plain HTTP request, or None to go on with the websocket handshake."""
        path = request.path.partition("?")[0]
        if path == "/healthz":
            return connection.respond(HTTPStatus.OK, "OK\n")
        if not self._authorized(request):
            self._metrics.error("unauthorized")
            response = connection.respond(HTTPStatus.UNAUTHORIZED, "Send the header `Authorization: Api-Key <key>`.\n")
            response.headers["WWW-Authenticate"] = "Api-Key"
            return response
        if path == "/metrics":
            response = connection.respond(HTTPStatus.OK, self._metrics.text())
            del response.headers["Content-Type"]
            response.headers["Content-Type"] = CONTENT_TYPE
            return response
        hosts = request.headers.get_all("Host")
        for origin in request.headers.get_all("Origin"):
            # Browsers let every web page connect to 127.0.0.1, but say which page it is. Robots send no Origin.
            if [urlsplit(origin).netloc] != hosts:
                self._metrics.error("origin")
                return connection.respond(HTTPStatus.FORBIDDEN, f"Pages of {origin} may not use this server.\n")
        return None

    def _authorized(self, request: Request) -> bool:
        if self._key is None:
            return True
        headers = request.headers.get_all("Authorization")
        scheme, _, key = headers[0].partition(" ") if len(headers) == 1 else ("", "", "")
        given = key.strip().encode(errors="replace")
        return scheme.lower() == "api-key" and hmac.compare_digest(given, self._key)  # in constant time
