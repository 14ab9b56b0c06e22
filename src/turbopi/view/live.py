"""The calls of a live server, from its page's feed: samples, as a robot may ask more often than the feed tells."""

import contextlib
import time
from collections.abc import Iterator
from urllib.parse import urlsplit

import msgspec
import numpy as np
from websockets.exceptions import ConnectionClosed, InvalidStatus, InvalidURI, WebSocketException
from websockets.sync.client import ClientConnection, connect

from turbopi.serve.page.http import FEED
from turbopi.serve.page.messages import FEED_VERSION, Frame, Hello, Preview, RobotFrame, Trouble, clean
from turbopi.support.errors import ConfigError
from turbopi.view.calls import EncodedImage, ViewedCall, ViewedTrouble

MAX_MESSAGE = 64 * 2**20
SILENCE = 60.0  # seconds without a frame, of which there should be some a second
_DECODER = msgspec.json.Decoder(Hello | Frame)


class LiveServer:
    """A connection to a server's feed. `hello` is what it is.

    url  http://HOST:PORT, ws://…, https://… or wss://…

    Raises ConfigError, saying why, if there is no such feed for whoever asks.
    """

    def __init__(self, url: str, api_key: str | None = None) -> None:
        self.url = _feed_url(url)
        self._open = contextlib.ExitStack()
        headers = {"Authorization": f"Api-Key {api_key}"} if api_key else None
        try:
            socket = connect(self.url, additional_headers=headers, max_size=MAX_MESSAGE, proxy=None)
            self._socket: ClientConnection = self._open.enter_context(socket)
        except InvalidStatus as error:
            reported = (error.response.body or b"").decode(errors="replace").strip()
            if error.response.status_code == 401:
                reported = "it wants its API key: --api-key-file FILE, or TURBOPI_API_KEY"
            raise ConfigError(f"can't watch {url}: {clean(reported) or error}") from error
        except (InvalidURI, ValueError) as error:
            raise ConfigError(f"{url} is no address of a server: {error}") from error
        except (OSError, TimeoutError, WebSocketException) as error:
            raise ConfigError(f"can't watch {url}: {error}. Is `turbopi serve` running there?") from error
        try:
            self.hello = self._read_hello(url)
        except BaseException:
            self.close()
            raise

    def _read_hello(self, url: str) -> Hello:
        other = f"{url} isn't a server of this Turbo-Pi's version: watch it with the version that serves there"
        try:
            first = self._socket.recv(timeout=SILENCE)
            hello = _DECODER.decode(first) if isinstance(first, str) else None
        except (msgspec.DecodeError, ConnectionClosed, TimeoutError) as error:
            raise ConfigError(other) from error
        if not isinstance(hello, Hello) or hello.feed != FEED_VERSION:
            raise ConfigError(other)
        return hello

    def close(self) -> None:
        self._open.close()

    def watch(self, seconds: float | None = None) -> Iterator[ViewedCall | ViewedTrouble]:
        """What robots do from now on: until the server ends, or for so many seconds."""
        deadline = None if seconds is None else time.monotonic() + seconds
        reported: set[Trouble] = set()
        while True:
            left = SILENCE if deadline is None else min(SILENCE, deadline - time.monotonic())
            if left <= 0:
                return
            try:
                frame = _DECODER.decode(self._socket.recv(timeout=left))
            except TimeoutError:
                if deadline is None:
                    raise ConfigError(f"{self.url} says nothing more") from None
                return
            except ConnectionClosed:
                return
            assert isinstance(frame, Frame)
            yield from (_call(robot, robot.preview) for robot in frame.robots if robot.preview is not None)
            new = [trouble for trouble in frame.troubles if trouble not in reported]
            reported = set(frame.troubles)
            yield from (ViewedTrouble(one.time, clean(f"{one.error}: {one.text}")) for one in new)


def _call(robot: RobotFrame, preview: Preview) -> ViewedCall:
    return ViewedCall(
        robot=robot.name or robot.address,
        number=preview.number,
        time=preview.time,
        prompt=preview.prompt,
        actions=np.array(preview.actions, np.float64) if preview.actions else None,
        camera_images={
            name: EncodedImage(camera_image.jpeg, "image/jpeg") for name, camera_image in preview.images.items()
        },
        numbers={key: np.array(values, np.float64) for key, values in preview.numbers.items()},
        timing={stage: value for stage, value in preview.timing.items() if value is not None},
    )


def _feed_url(url: str) -> str:
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError as error:
        raise ConfigError(f"{url} is no address of a server: {error}") from error
    schemes = {"http": "ws", "ws": "ws", "https": "wss", "wss": "wss"}
    if parts.scheme not in schemes or parts.hostname is None or "@" in parts.netloc:
        raise ConfigError(f"{url} is no address of a server: expected http://HOST:PORT or ws://HOST:PORT")
    host = f"[{parts.hostname}]" if ":" in parts.hostname else parts.hostname
    place = host if port is None else f"{host}:{port}"
    return f"{schemes[parts.scheme]}://{place}{parts.path.rstrip('/')}{FEED}"
