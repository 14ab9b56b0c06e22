"""Load a policy server, Turbo-Pi's or openpi's own, and see how long its answers take. From the repository:

    export PYTHONPATH=src:tools
    python -m load_test ws://127.0.0.1:8000 --out one.json                 one client, as fast as it is answered
    python -m load_test ws://127.0.0.1:8000 --clients 8 --out eight.json
    python -m load_test ws://gpu:8000 --clients 12 --rate 60               each robot five times a second
    python -m load_test ws://gpu:8000 --clients 12 --poisson 60            at random
    python -m load_test ws://127.0.0.1:8000 --clients 8 --client bare --processes 1    clients that need few cores
    python -m load_test ws://127.0.0.1:8000 --client openpi --python .venv-openpi-client/bin/python
    python -m load_test ws://127.0.0.1:8000 --robot droid --images 640x480
    python -m load_test --show eight.json                                  the table of a result

Closed loop: each client sends its next request when it has the answer to the one before. Open loop (--rate, --poisson):
requests are due whether or not the server keeps up, and latency counts from when they were due. A client is one
connection with one request at a time, and a process of its own; the result says how busy they were.

An API key: --api-key-file, or the variable TURBOPI_API_KEY. Exit codes: 0, 1 no request was answered, 2 bad usage.
"""

import argparse
import json
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from load_test.document import COLUMNS, LoadDocument, read_load, tables
from load_test.observations import image_size
from load_test.run import Wanted, run
from turbopi.cli.api_key import chosen_key
from turbopi.support.errors import TurboPiError
from turbopi.support.files import write_whole
from turbopi.support.reading import plain_document

UNANSWERED, BAD_USAGE = 1, 2


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m load_test", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("url", nargs="?", help="the server's: ws://HOST:PORT")
    parser.add_argument("--show", type=Path, metavar="FILE", help="only show this result")
    parser.add_argument("--out", type=Path, metavar="FILE", help="write the result here (JSON)")
    parser.add_argument("--clients", type=int, default=1, metavar="N")
    loop = parser.add_mutually_exclusive_group()
    loop.add_argument("--rate", type=float, metavar="R", help="R requests a second of all clients, in turn")
    loop.add_argument("--poisson", type=float, metavar="R", help="R requests a second of all clients, at random")
    parser.add_argument("--seconds", type=float, default=Wanted.seconds, metavar="S", help="that are measured")
    parser.add_argument("--warmup", type=float, default=Wanted.warmup, metavar="S", help="before that")
    parser.add_argument("--drain", type=float, default=Wanted.drain_s, metavar="S", help="to send what is late, after")
    parser.add_argument("--processes", type=int, metavar="P", help="of the clients; default: one each")
    parser.add_argument(
        "--client",
        choices=("turbopi", "openpi", "bare"),
        default="turbopi",
        help="whose client; bare: sends prepared bytes",
    )
    parser.add_argument("--python", metavar="FILE", help="the clients' interpreter, such as one with openpi-client")
    parser.add_argument("--robot", help="whose observations: a name or a .json; default: as the server's metadata says")
    parser.add_argument("--observation", type=Path, metavar="FILE", help="or one that was recorded")
    size = "size of all images; default: the robot's own"
    parser.add_argument("--pictures", dest="camera_images", metavar="WxH", help=size)
    parser.add_argument("--seed", type=int, default=0, help="of images and arrivals")
    parser.add_argument("--api-key-file", type=Path, metavar="FILE", help="its one line is the server's API key")
    given = parser.parse_args(arguments)
    console = Console(width=COLUMNS)
    try:
        if given.show is not None:
            show(read_load(given.show), console)
            return 0
        if given.url is None:
            parser.error("give the server's URL, or --show FILE")
        document = run(
            _wanted(given), ["python", "-m", "load_test", *(sys.argv[1:] if arguments is None else arguments)]
        )
        if given.out is not None:
            write_whole(given.out, (json.dumps(plain_document(document), indent=1) + "\n").encode())
    except TurboPiError as error:
        print(f"error: {error}", file=sys.stderr)
        return BAD_USAGE
    show(document, console)
    return 0 if document.answered else UNANSWERED


def _wanted(given: argparse.Namespace) -> Wanted:
    return Wanted(
        url=given.url,
        api_key=chosen_key(os.environ.get("TURBOPI_API_KEY") or None, given.api_key_file),
        client=given.client,
        arrivals="fixed" if given.rate is not None else "poisson" if given.poisson is not None else "closed",
        rate=given.rate if given.rate is not None else given.poisson,
        clients=given.clients,
        processes=given.processes,
        seconds=given.seconds,
        warmup=given.warmup,
        drain_s=given.drain,
        seed=given.seed,
        robot=given.robot,
        observation=given.observation,
        camera_images=None if given.camera_images is None else image_size(given.camera_images),
        python=given.python,
    )


def show(document: LoadDocument, console: Console) -> None:
    for part in tables(document):
        console.print(part, markup=False, highlight=False)


if __name__ == "__main__":
    sys.exit(main())
