"""Time the tiles of the portable products on this GPU, beside the library's products:

    PYTHONPATH=src:tools python3 -m product_tiles --json product_tiles.json

Prints the fastest tiles and the lines for `MEASURED` in kernels/portable/gemm/tiles.py.
"""

import argparse
import json
import os
import time
from pathlib import Path

from rich.console import Console
from rich.table import Table

SHOWN = 3  # tiles of a product


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m product_tiles", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rows", default="512:560,4096:4480", help="vision's and the prefix's rows of each call")
    parser.add_argument("--seconds", type=float, default=110, help="begin no further product after that")
    parser.add_argument("--json", type=Path, help="also write the result here")
    given = parser.parse_args()
    from product_tiles.document import TilesDocument
    from product_tiles.timing import DEVICE, products, time_all
    from turbopi.kernels.portable.gemm.kernel import gpu
    from turbopi.kernels.portable.gemm.tiles import fp8_refusal
    from turbopi.provenance import provenance
    from turbopi.reading import plain_document

    started, capability = time.monotonic(), gpu(DEVICE)[0]
    rows = [[int(number) for number in pair.split(":")] for pair in given.rows.split(",")]
    kinds = (True, False) if fp8_refusal(capability) is None else (False,)
    wanted = [one for pair in rows for fp8 in kinds for one in products(pair[0], pair[1], fp8)]
    done, left_out = time_all(wanted, given.seconds, min(8, os.cpu_count() or 1))
    seconds = time.monotonic() - started
    document = TilesDocument(provenance(DEVICE), capability, seconds, done, left_out)
    if given.json is not None:
        given.json.write_text(json.dumps(plain_document(document), indent=1) + "\n")
    show(document, Console(width=110))


def show(document, console: Console) -> None:  # type: ignore[no-untyped-def]
    table = Table("product", "rows", "in", "library", "chosen", f"fastest {SHOWN} (µs)", box=None)
    for one in document.products:
        taken = {row.tile: row.microseconds for row in one.tiles}
        fastest = "\n".join(f"{row.microseconds:.1f} {row.tile}" for row in one.tiles[:SHOWN])
        library = "" if one.by_library is None else f"{one.by_library:.1f}"
        chosen = f"{taken[one.chosen]:.1f}" if one.chosen in taken else "failed"
        table.add_row(one.name, str(one.rows), "E4M3" if one.in_fp8 else "bf16", library, chosen, fastest)
    console.print(table)
    for one in document.products:
        if one.tiles:
            shape = (document.capability, one.in_fp8, one.epilogue, -(-one.rows // 64) * 64, one.columns, one.inner)
            console.print(f"    {shape}: Tile{one.tiles[0].tile},", markup=False, highlight=False, soft_wrap=True)
        for tile, why in one.failed.items():
            console.print(f"{one.name}, {tile}: {why}", markup=False)
    for name in document.left_out:
        console.print(f"left out, time was up: {name}")
    console.print(f"{document.seconds:.0f} s")


if __name__ == "__main__":
    main()
