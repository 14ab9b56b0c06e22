"""examples/cpp/turbopi.hpp, compiled with sanitizers: what it sends and reads, and what it does to a hostile server."""

import random
import shutil
import socket
import subprocess
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import websockets.sync.server
from serve_fakes import FakePolicy

from turbopi import UnifiedPolicy
from turbopi.checkpoint import random_checkpoint
from turbopi.realtime.wire import pack
from turbopi.serve import running

COMPILER = shutil.which("g++")
pytestmark = [pytest.mark.slow, pytest.mark.skipif(COMPILER is None, reason="needs g++: apt-get install g++")]

FOLDER = Path(__file__).parents[1] / "examples" / "cpp"
# arguments: port, key, answer_s, how many calls, prompt
PROGRAM = r"""
#include <cstdio>
#include <cstdlib>
#include "turbopi.hpp"
using namespace turbopi;

int main(int, char** words) try {
  Client client("127.0.0.1", std::atoi(words[1]), words[2], std::atof(words[3]));
  for (int call = std::atoi(words[4]); call > 0; --call) try {
    const double state[] = {0.5, -1, 1e30};
    const uint8_t image[] = {0, 1, 2, 253, 254, 255};
    const int16_t counts[] = {-2, 300};
    const bool seen[] = {true, false, true};
    Map map;
    map["observation/state"] = Array::of(state, {3});
    map["image"] = Array::of(image, {1, 2, 3});
    map["counts"] = Array::of(counts, {2});
    map["seen"] = Array::of(seen, {3, 1});
    map["more"] = List{nullptr, true, -7, 40000, 2.5, "ä", Map{{"deep", List{}}}};
    map["long"] = std::string(70000, 'x');
    map["prompt"] = words[5];
    const Chunk chunk = actions(client.infer(map));
    std::printf("actions %zu %zu %g\n", chunk.rows, chunk.columns, chunk.values.back());
  } catch (const Refused& error) {
    std::printf("refused %s\n", error.what());
  } catch (const Lost& error) {
    std::printf("lost %s\n", error.what());
  }
} catch (const Lost& error) {
  std::printf("lost at once %s\n", error.what());
}
"""


def compiled(source: Path, program: Path) -> Path:
    options = ["-std=c++17", "-O1", "-Wall", "-Wextra", "-Wconversion", "-Werror", "-fsanitize=address,undefined"]
    options += ["-fno-sanitize-recover=all", f"-I{FOLDER}"]
    subprocess.run([str(COMPILER), *options, str(source), "-o", str(program)], check=True)
    return program


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    source = tmp_path_factory.mktemp("cpp") / "asks.cpp"
    source.write_text(PROGRAM)
    return compiled(source, source.with_suffix(""))


def run(program: Path, *arguments: object) -> list[str]:
    ended = subprocess.run([program, *map(str, arguments)], capture_output=True, timeout=300, check=False)
    printed = ended.stdout.decode(errors="replace")
    assert ended.returncode == 0, printed[-1000:] + ended.stderr.decode(errors="replace")[-3000:]
    return printed.split("\n")[:-1]


def test_what_it_sends_arrives_and_what_comes_back_is_read(program: Path) -> None:
    policy = FakePolicy()
    with running(policy, api_key="secret") as server:
        assert run(program, server.port, "secret", 60, 2, "go on") == ["actions 2 3 1e+30"] * 2
        (refused,) = run(program, server.port, "other", 60, 1, "go on")
    assert refused.startswith("lost at once") and "it answers HTTP/1.1 401" in refused
    seen = policy.observations["go on"]
    expected: dict[str, Any] = {
        "observation/state": np.array([0.5, -1, 1e30]),
        "image": np.array([[[0, 1, 2], [253, 254, 255]]], np.uint8),
        "counts": np.array([-2, 300], np.int16),
        "seen": np.array([[True], [False], [True]]),
    }
    for key, value in expected.items():
        assert seen[key].dtype == value.dtype
        np.testing.assert_array_equal(seen[key], value)
    assert seen["more"] == [None, True, -7, 40000, 2.5, "ä", {"deep": []}] and seen["long"] == "x" * 70000


def test_a_server_says_why_there_are_no_actions(program: Path) -> None:
    with running(FakePolicy()) as server:
        assert (
            run(program, server.port, "", 60, 2, "nan actions")
            == ["refused bad actions: the actions hold nan at [0, 3]"] * 2
        )
        lines = run(program, server.port, "", 60, 3, "crash")  # a traceback, then the connection's end
    assert [line.split()[0] for line in lines if line.startswith(("refused ", "lost "))] == [
        "refused",
        "lost",
        "refused",
    ]


def test_a_server_that_says_nothing_is_left_in_time(program: Path) -> None:
    policy = FakePolicy()
    with running(policy) as server:
        lines = run(program, server.port, "", 0.3, 1, "hold")
        policy.release.set()
    assert lines[0].endswith("no answer in time")
    assert "Connection refused" in run(program, server.port, "", 60, 1, "hold")[0]


def broken(count: int) -> Iterator[bytes | str]:
    """Answers of which some bits are wrong, or that end too soon; the last one is right."""
    draw = random.Random(0)
    whole = pack({"actions": np.ones((2, 3)), "policy_timing": {"infer_ms": np.float32(1)}, "more": [1, -1, None, "x"]})
    for number in range(count - 1):
        data = bytearray(whole)
        for _ in range(draw.randrange(4)):
            data[draw.randrange(len(data))] = draw.choice((0, 0x7F, 0xC1, 0xDD, 0xDF, 0xFF, draw.randrange(256)))
        yield bytes(data[: draw.randrange(len(data)) if number % 2 else None])
    yield whole


def test_no_answer_breaks_it(program: Path) -> None:
    answers = broken(400)

    def answer(connection: websockets.sync.server.ServerConnection) -> None:
        connection.send(pack({}))
        for _ in connection:
            connection.send(next(answers))

    with websockets.sync.server.serve(answer, "127.0.0.1", 0, compression=None) as server:
        serving = threading.Thread(target=server.serve_forever)
        serving.start()
        try:
            lines = run(program, server.socket.getsockname()[1], "", 60, 400, "go on")
        finally:
            server.shutdown()
            serving.join()
    assert len(lines) == 400 and lines[-1] == "actions 2 3 1"
    assert sum(line.startswith("lost ") for line in lines) > 200


def says(*answers: bytes) -> Iterator[int]:
    """The port of a server that gives each call one of these answers: any frames."""

    def answer() -> None:
        connection, _ = listener.accept()
        with connection, connection.makefile("rb") as reader, suppress(ConnectionError):
            connection.recv(65536)
            connection.sendall(b"HTTP/1.1 101 Ok\r\nAccept: s3pPLMBiTxaQ9kYGzzhZRbK+xOo=\r\n\r\n\x82\x01\x80")
            for frames in answers:
                while (head := reader.read(2))[0] & 15 > 2:  # a pong
                    reader.read(4 + (head[1] & 127))
                reader.read(4 + int.from_bytes(reader.read(8), "big"))
                connection.sendall(frames)
            connection.recv(65536)

    with socket.create_server(("127.0.0.1", 0)) as listener:
        answering = threading.Thread(target=answer)
        answering.start()
        yield listener.getsockname()[1]
        answering.join()


def frame(message: bytes, kind: int = 0x82) -> bytes:
    return bytes([kind, 127]) + len(message).to_bytes(8, "big") + message


def test_an_answer_that_nobody_asked_for_is_not_the_next_calls(program: Path) -> None:
    once, again = (frame(pack({"actions": np.full((2, 3), value)})) for value in (1.0, 2.0))
    for port in says(once + frame(b"ping", 0x89), once + again):
        lines = run(program, port, "", 60, 3, "go on")
    assert lines[:2] == ["actions 2 3 1"] * 2 and lines[2].endswith("an answer that nobody asked for")


def test_no_answer_costs_more_than_its_bytes_or_has_numbers_that_no_robot_may_get(program: Path) -> None:
    far = np.ones((2, 3))
    far[1, 2] = 1e39
    for port in says(frame(pack({"actions": far})), frame(b"\xdd\x00\x10\x00\x00" + bytes(2**20))):
        lines = run(program, port, "", 60, 2, "go on")
    assert lines[0] == "lost actions aren't finite in float" and lines[1].endswith(
        "more than 20000 values in one message"
    )


def test_no_frame_breaks_it(program: Path) -> None:
    """After a right greeting, bytes that may be frames of any kind and length; then the connection's end."""
    draw = random.Random(0)
    metadata = b"\x82\x01\x80"

    def answer() -> None:
        while True:
            try:
                connection, _ = listener.accept()
            except OSError:  # shut down
                return
            with connection, suppress(ConnectionError):
                connection.recv(65536)
                connection.sendall(b"HTTP/1.1 101 Ok\r\nAccept: s3pPLMBiTxaQ9kYGzzhZRbK+xOo=\r\n\r\n" + metadata)
                connection.recv(65536)
                kind = draw.choice((0x82, 0x02, 0x81, 0x89, 0x88, 0))
                connection.sendall(bytes([kind]) + draw.randbytes(draw.randrange(200)))

    with socket.create_server(("127.0.0.1", 0)) as listener:
        answering = threading.Thread(target=answer)
        answering.start()
        try:
            lines = run(program, listener.getsockname()[1], "", 60, 100, "go on")
        finally:
            listener.shutdown(socket.SHUT_RDWR)
            answering.join()
    assert len([line for line in lines if line.startswith(("lost ", "refused "))]) >= 100


@pytest.mark.usefixtures("two_layers")
def test_the_example_joins_chunks(tmp_path: Path) -> None:
    example = compiled(FOLDER / "client.cpp", tmp_path / "client")
    with running(UnifiedPolicy(random_checkpoint("pi05_tiny"), device="cpu", precision="f32")) as server:
        lines = run(example, "127.0.0.1", server.port)
    assert [line.split(", ")[0] for line in lines] == ["10 actions of 7 numbers"] * 3
    assert [line.endswith("joined") for line in lines] == [False, True, True]
