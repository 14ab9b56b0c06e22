"""The server's page in a real browser, while robots ask."""

import itertools
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from chromium import PROGRAM, Page, chromium
from serve_fakes import FakePolicy, observation
from websockets.sync.client import connect

from turbopi.policy.watch import Outside, Reading, Sample
from turbopi.realtime.wire import pack
from turbopi.serve import PolicyServer, running
from turbopi.support.errors import ObservationError

pytestmark = [pytest.mark.slow, pytest.mark.skipif(PROGRAM is None, reason="needs Chromium: apt-get install chromium")]

HOSTILE = "</script><img src=x onerror=\"document.title='owned'\"><b>bowl</b>"
ACTIONS = np.stack([np.linspace(-1, 1, 5), *(np.full(5, value) for value in (0, 0.5, 0, 0, 0, -1))], axis=1)


# of all text that is seen
SIZES = """[...document.querySelectorAll("main *")].filter((one) => one.checkVisibility() &&
    [...one.childNodes].some((child) => child.nodeType == 3 && child.data.trim()))
    .map((one) => getComputedStyle(one).fontSize)"""

# of the image's middle
COLOUR = """(async () => {
    const image = document.querySelector('.robot img[alt="front"]'), canvas = new OffscreenCanvas(9, 9);
    const context = canvas.getContext("2d");
    await image.decode();
    context.drawImage(image, 0, 0);
    return [...context.getImageData(4, 4, 1, 1).data].slice(0, 3);
})()"""


class Arm(FakePolicy):
    def __init__(self) -> None:
        super().__init__()
        self.metadata = {
            "config": "pi05_libero",
            "robot": "libero",
            "robot_action_dim": 7,
            "action_horizon": 5,
            "backend": "fused",
            "backend_reason": f"auto: the fastest {HOSTILE}",
            "device": "cpu",
            "features": {
                "state": [{"name": name, "unit": "m", "low": 0.0, "high": 1.0} for name in "xyz"],
                "actions": [
                    {"name": name, "unit": "1 = 0.05 m a step", "low": low, "high": None if low is None else 0.5}
                    for name, low in (("x", -0.5), ("y", 0.0), ("z", None))
                ],
            },
        }

    gives_readings = True

    def infer(self, obs: dict[str, Any], readings: bool = False) -> dict[str, Any]:
        assert readings
        if obs["prompt"] == "wrong":
            raise ObservationError(f"it holds {HOSTILE}")
        far = Outside("z", 2.0, 0.0, 1.0, far=True)
        black = {"front": Sample((2, 2), bytes(12))}
        timing = {"vision_ms": 1.25, "denoise_ms": 2.5, "infer_ms": 4.0}
        return {
            "actions": ACTIONS,
            "policy_timing": timing,
            "reading": Reading([0.0, 0.5, 2.0], (), (far,), images=black),
        }


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with chromium(tmp_path_factory.mktemp("browser")) as page:
        page.resize(1000, 900)
        yield page


@contextmanager
def robot(server: PolicyServer, prompt: str, *, key: str = "", name: str = "") -> Iterator[None]:
    """A robot that asks on and on."""
    named = {"turbopi/robot": name} if name else {}
    done, failed = threading.Event(), list[BaseException]()
    camera_image = np.zeros((32, 64, 3), np.uint8)
    camera_image[..., 0] = 200

    def run() -> None:
        try:
            headers = {"Authorization": f"Api-Key {key}"} if key else None
            with connect(server.url, compression=None, additional_headers=headers) as connection:
                connection.recv()
                for number in itertools.count():
                    connection.send(pack(observation(prompt) | named | {"front": camera_image}))
                    assert isinstance(connection.recv(), bytes)
                    if number == 3:
                        connection.send(pack(observation("wrong")))
                        assert "it holds" in str(connection.recv())
                    if done.wait(0.05):
                        return
        except BaseException as error:
            failed.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join(60)
        assert not failed, failed


def address(server: PolicyServer) -> str:
    return server.url.replace("ws://", "http://") + "/"


def text(page: Page, selector: str) -> str:
    return str(page.value(f"document.querySelector({selector!r}).textContent"))


def test_the_page_shows_robots_chunks_latency_errors_and_the_backend(page: Page) -> None:
    page.console.clear()
    page.requested.clear()
    with running(Arm()) as server, robot(server, HOSTILE):
        page.open(address(server))
        page.until("document.querySelectorAll('.robot img').length == 2")
        page.until("document.querySelector('#troubles').textContent.includes('it holds')")
        page.until("document.querySelector('.robot img').naturalWidth > 0")
        # hostile text is text
        assert text(page, ".prompt") == f"“{HOSTILE}”"
        assert HOSTILE in text(page, "#policy") and HOSTILE in text(page, "#troubles")
        assert page.value("document.title") == "Turbo-Pi: pi05_libero"
        assert page.value("document.querySelectorAll('.prompt *, #policy dd *, #troubles img').length") == 0
        # its image, in its colour
        red, green, _ = page.value(COLOUR)
        assert abs(red - 200) < 8 and green < 8
        assert "front\n64 × 32" in text(page, ".images")
        # the chunk: a line a dimension, from the bottom left to the top right for the first
        titles = page.value("[...document.querySelectorAll('.plots h4 div')].map((title) => title.firstChild.data)")
        assert [title.strip() for title in titles] == ["translation", "rotation", "gripper"]
        lines = page.value(
            "[...document.querySelectorAll('.plots polyline')].map((line) => line.getAttribute('points'))"
        )
        rising, *_ = drawn = [[tuple(map(float, point.split(","))) for point in line.split()] for line in lines]
        assert [len(points) for points in drawn] == [5] * 7
        heights = [y for _, y in rising]  # from the top
        assert rising == sorted(rising) and heights == sorted(heights, reverse=True)
        (level,) = {y for _, y in drawn[2]}  # 0.5
        assert heights[4] < level < heights[2]
        # state and training range: z is at 2, in training 0 to 1
        assert page.value("[...document.querySelectorAll('.state .row')].map((row) => row.textContent)") == [
            "x0 m",
            "y0.5 m",
            "z2 m",
        ]
        places = page.value("[...document.querySelectorAll('.track i')].map((mark) => mark.style.left)")
        assert places == ["25%", "50%", "100%"]
        assert page.value("document.querySelectorAll('.axes .range').length") == 2  # the third isn't known
        assert page.value("document.querySelectorAll('.state .wrong').length") == 1 and "z is 2" in text(page, ".notes")
        assert page.value("document.querySelectorAll('figure.wrong').length") == 1
        # numbers
        rows = page.value("[...document.querySelectorAll('#latency tr')].map((row) => row.innerText.split('\\t'))")
        medians = {row[0]: row[1] for row in rows}
        assert list(medians) == ["vision", "denoise", "infer", "request"]
        assert (medians["vision"], medians["denoise"], medians["infer"]) == ("1.25", "2.50", "4.00")
        assert text(page, "#clients") == "1" and text(page, "#kinds") == "observation 1"
        assert "fused" in text(page, "#policy") and "GB" in text(page, "#memory")
        assert int(text(page, "#requests").replace(",", "")) >= 4
        calls = page.value("Number(document.querySelector('.robot').dataset.call)")
        page.until(f"Number(document.querySelector('.robot').dataset.call) > {calls}")  # it is live
        for width in (390, 1000, 2560):
            page.resize(width, 900)
            assert page.value("document.documentElement.scrollWidth") <= width
            assert set(page.value(SIZES)) <= {"11px", "12px", "14px", "16px", "20px"}
        page.resize(1000, 900)
        assert page.screenshot()[1:4] == b"PNG"
    page.until("document.querySelector('#status').className == 'status down'")
    assert "since" in text(page, "#status")
    own = {address(server), server.url + "/live", address(server) + "healthz"}
    assert {url for url in page.requested if not url.startswith("data:")} <= own
    page.open("about:blank")
    assert [line for line in page.console if "ERR_CONNECTION" not in line] == []


def test_robots_come_and_go(page: Page) -> None:
    with running(Arm()) as server:
        page.open(address(server))
        page.until("document.querySelector('#no-robots').hidden === false && !document.querySelector('#all').hidden")
        with robot(server, "first"):
            with robot(server, "second", name="left arm"):
                page.until("document.querySelectorAll('.robot img').length == 4")
                assert page.value("document.querySelectorAll('.robot').length") == 2
            page.until("document.querySelectorAll('.robot.gone').length == 1")
            assert text(page, ".robot.gone h3") == "left arm" and "gone since" in text(page, ".robot.gone")
            assert text(page, ".robot:not(.gone) .prompt") == "“first”"
            with robot(server, "second", name="left arm"):
                page.until("!document.querySelector('.robot.gone')")
                assert (
                    page.value(
                        "[...document.querySelectorAll('h3')].filter((one) => one.textContent == 'left arm').length"
                    )
                    == 1
                )
        page.until("document.querySelectorAll('.robot.gone').length == 2")
        page.open("about:blank")


def test_a_policy_of_another_make_has_its_numbers_shown_without_names(page: Page) -> None:
    class Other(Arm):
        gives_readings = False

        def infer(self, obs: dict[str, Any], readings: bool = True) -> dict[str, Any]:
            answer = super().infer(obs, readings=readings)
            return {key: value for key, value in answer.items() if key != "reading"}

    for features in ("none", {"state": {"dtype": "float32"}, "actions": [{"name": 3}]}):
        policy = Other()
        policy.metadata |= {"features": features, "robot": "other", "robot_action_dim": 7}
        with running(policy) as server, robot(server, "first"):
            page.open(address(server))
            page.until("document.querySelectorAll('.axes polyline').length == 7")
            assert text(page, ".joint").startswith("dim") and "observation/state: -1.000" in text(page, ".values")
            assert page.value("document.querySelectorAll('.track, .range').length") == 0
            page.open("about:blank")


def test_the_page_asks_for_the_key_and_says_when_it_is_wrong(page: Page) -> None:
    def give(key: str) -> None:
        page.until("document.querySelector('#ask') && !document.querySelector('#ask').hidden")
        page.value(f"document.querySelector('#key').value = {key!r}; document.querySelector('#ask button').click()")

    with running(Arm(), api_key="s3cret/+~") as server, robot(server, "go on", key="s3cret/+~"):
        page.open(address(server))
        give("wrong")
        page.until("!document.querySelector('#wrong').hidden")
        assert text(page, "#wrong") == "The server refused this key."
        assert page.value("document.querySelector('#all').hidden") is True
        give("s3cret/+~")
        page.until("document.querySelectorAll('.robot img').length == 2")
        assert page.value("document.querySelector('#ask').hidden") is True
        page.open("about:blank")


def test_a_page_from_elsewhere_cannot_watch(page: Page) -> None:
    """What a browser itself sends: a page of another port of this machine is another origin."""
    with running(Arm()) as server, running(Arm()) as other:
        page.open(address(other))
        page.until("document.body && document.body.dataset.frames > 0")
        # the page's own policy would stop it first: it is bypassed to ask the server
        page.call("Page.setBypassCSP", enabled=True)
        page.open(address(other))
        page.until("document.body && document.body.dataset.frames > 0")
        ended = page.value(
            f"new Promise((done) => {{ const feed = new WebSocket({server.url + '/live'!r});"
            "feed.onopen = () => done('open'); feed.onerror = () => done('refused'); })"
        )
        assert ended == "refused"
        page.call("Page.setBypassCSP", enabled=False)
        page.open("about:blank")
