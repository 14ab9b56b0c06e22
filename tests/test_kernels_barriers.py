"""The tables of barriers in the denoising kernels' CUDA source say what the code does: barriers.cu; portable/kernel.cu.

The code is read as text: each place that names a barrier is an initialisation, an armed number of bytes, an arrival or
a wait of the function around it. Nothing is compiled.
"""

import re
from collections import Counter
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import pytest

from turbopi.kernels.portable.denoise import kernel as portable
from turbopi.kernels.sm90.denoise import kernel as hopper

FOLDER = Path(hopper.__file__).parent
PORTABLE = Path(portable.__file__).parent
INSTRUCTIONS = r'"[^"]*\b(?:mbarrier\.(?!.*complete_tx)|bar\.sync|bar\.arrive|barrier\.cluster)'
# Functions that make an instruction of the barrier that they are given, by name.
PRIMITIVES = ("arrive_at", "arrive", "sync", "receive", "consumers_sync", "consumers_arrive")
OPERATIONS = r"(?<!\w)(?:barrier_(?:init|expect|arrive|wait|over)|arrive_at|receive)\("
HANDED_ON = {"expect_hidden": "hidden_bytes(b)"}  # a number of bytes that `consume` makes once


@dataclass
class Barrier:
    """What the table or the code says of one. Places are counted: "few/gather", "Own::meet(2)"."""

    count: str = ""  # arrivals that end a phase, as `barrier_init` has them; of a CTA's warps the barrier's number
    bytes: str = ""  # that are armed for each phase
    arrives: Counter[str] = field(default_factory=Counter)
    waits: Counter[str] = field(default_factory=Counter)  # with the phase, or of a CTA's warps their number


Barriers = dict[str, Barrier]


def read(folder: Path) -> dict[str, str]:
    """{"few/stream": its text} of a folder's CUDA files."""
    return {path.relative_to(folder).with_suffix("").as_posix(): path.read_text() for path in folder.rglob("*.cu")}


def squeezed(text: str) -> str:
    return " ".join(text.split())


@lru_cache(1000)
def code(text: str) -> str:
    """Without comments, macros' definitions, and braces in strings."""
    text = re.sub(r"//[^\n]*", "", text)
    text = re.sub(r"^#(?:[^\n]*\\\n)*[^\n]*$", "", text, flags=re.MULTILINE)
    return re.sub(r'"(?:[^"\\]|\\.)*"', lambda found: re.sub(r"[{}();]", " ", found[0]), text)


@lru_cache(1000)
def functions(name: str, text: str) -> list[tuple[str, str]]:
    """(name, body) of a file's functions: "few/Embedding::send". Members' initialisers are of a constructor's body."""
    found = []
    text = code(text)
    form = f"{Path(name).parent}/" if "/" in name else ""
    scopes: list[tuple[str, int]] = []  # names of open structs and functions ("" of other blocks), where each begins
    header = 0
    for mark in re.finditer(r"[{};]", text):
        at, sign = mark.start(), mark[0]
        if sign == "{":
            head = re.sub(r"__\w+__(\([^()]*\))?", "", text[header:at])
            inside = any(scope.endswith("()") for scope, _ in scopes)
            struct, function = (
                re.search(r"\bstruct (?:alignas\(\d+\) )?(\w+)[^()]*$", head),
                re.search(r"(\w+)\s*\(", head),
            )
            scope = "" if inside else struct[1] if struct else f"{function[1]}()" if function else ""
            members = re.search(r"\)\s*:\s", text[header:at])
            scopes.append((scope, header + members.end() if members and scope.endswith("()") else at))
        elif sign == "}":
            scope, begin = scopes.pop()
            if scope.endswith("()"):
                structs = [one for one, _ in scopes if one]
                found.append((form + "::".join((*structs, scope[:-2])), text[begin : at + 1]))
        header = at + 1
    return found


def calls_around(body: str, at: int) -> list[tuple[str, list[str]]]:
    """(name, arguments) of the calls around a place, from the inside."""
    found, depth = [], 0
    for i in range(at - 1, -1, -1):
        depth += {")": 1, "(": -1}.get(body[i], 0)
        if depth < 0:
            name = re.search(r"[\w.]+$", body[:i])
            found.append((name[0] if name else "", arguments(body, i)))
            depth = 0
        elif body[i] in ";{}" and depth == 0:
            break
    return found


def arguments(body: str, opened: int) -> list[str]:
    found, depth, begin = [], 0, opened + 1
    for i in range(opened, len(body)):
        depth += {"(": 1, ")": -1}.get(body[i], 0)
        if (body[i] == "," and depth == 1) or depth == 0:
            found.append(squeezed(body[begin:i]))
            begin = i + 1
        if depth == 0:
            return found
    raise AssertionError(body[opened:])


def with_aliases(body: str) -> str:
    """`full = b.full(slot)` written out where it is used; the barrier behind a slot's full one is its empty one."""
    body = re.sub(r"start \+ M_BAR \+ \(BAR_RING \+ (\w+) \* 2\) \* 8", r"b.full(\1)", body)
    for name, place in re.findall(r"\b(\w+) = b\.full\((\w+)\)", body):
        body = body.replace(f"{name} = b.full({place})", "")
        body = re.sub(rf"\b{name} \+ 8\b", f"b.empty({place})", body)
        body = re.sub(rf"(?<![.\w]){name}\b", f"b.full({place})", body)
    return body


def mbarriers(files: dict[str, str]) -> Barriers:
    """The mbarriers of Hopper's kernel, as its code has them."""
    enums = [
        names.split(",") for text in files.values() for names in re.findall(r"enum \w*Barrier \{(.*?)\}", code(text))
    ]
    order = [name.split("=")[0].strip() for names in enums for name in names]
    order.remove("BAR_RING")
    found = {name: Barrier() for name in (*order, "full", "empty")}
    armed: dict[str, set[str]] = {name: set() for name in found}
    counts: dict[str, list[str]] = {name: [] for name in found}
    for file, text in files.items():
        for function, body in functions(file, text):
            body = with_aliases(body)
            if loop := re.search(
                r"for \(int i = (BAR_\w+); i <= (BAR_\w+); \+\+i\) barrier_init\(b.bar\(i\), arrivals\(b, i\)\)", body
            ):
                for name in order[order.index(loop[1]) : order.index(loop[2]) + 1]:
                    counts[name].append(by_form(files, name))
                body = body.replace(loop[0], "")
            if function.endswith("arrivals") or function in PRIMITIVES:
                continue
            for call in re.finditer(OPERATIONS, body):
                given = "".join(arguments(body, call.end() - 1))
                assert re.search(r"BAR_|b\.(full|empty)\(", given), f"{function}: a barrier without a name: {given}"
            for mention in re.finditer(r"\b(BAR_\w+)|\bb\.(full|empty)\(", body):
                name, around = mention[1] or mention[2], dict(calls_around(body, mention.start()))
                if name == "BAR_RING":
                    assert function == "Cta::full", f"{function} takes a slot's barrier in another way"
                    continue
                if "barrier_init" in around:
                    counts[name].append(around["barrier_init"][1])
                elif "barrier_expect" in around:
                    armed[name].add(around["barrier_expect"][1])
                elif "barrier_wait" in around:
                    found[name].waits[f"{function}({around['barrier_wait'][1]})"] += 1
                elif "receive" in around:
                    _, _, use, amount, _ = around["receive"]
                    found[name].waits[f"{function}({use})"] += 1
                    armed[name].add(HANDED_ON.get(amount, amount))
                else:
                    found[name].arrives[function] += 1
    for name, one in found.items():
        one.count = ", ".join(counts[name])
        one.bytes = "; ".join(bytes_of(files, amount) for amount in sorted(armed[name]))
    return found


def by_form(files: dict[str, str], name: str) -> str:
    """What `arrivals` of either form returns for a barrier."""
    found = []
    for form in ("few", "many"):
        body = next(
            body
            for function, body in functions(f"{form}/loop", files[f"{form}/loop"])
            if function == f"{form}/arrivals"
        )
        returned = squeezed(re.findall(r"return (.*?);", body)[0])
        special = re.fullmatch(r"(\w+) && bar == (BAR_\w+) \? (.*) : (.*)", returned)
        if special:
            returned = f"{special[1]} ? {special[3]} : {special[4]}" if special[2] == name else special[4]
        found.append(returned)
    return found[0] if found[0] == found[1] else f"few {found[0]}, many {found[1]}"


def bytes_of(files: dict[str, str], amount: str) -> str:
    """An armed amount with what it is: "V_EXPECT = few 2 * T, many 3 * T"."""
    name, defined = amount.partition("(")[0], []
    for file, text in sorted(files.items()):
        form = f"{Path(file).parent} " if "/" in file else ""
        for value in re.findall(rf"constexpr u32 {name} = (.*?);", code(text), re.DOTALL):
            defined.append(form + squeezed(value))
        for function, body in functions(file, text):
            if function.rpartition("/")[2] == name:
                returned = re.findall(r"(?:if \((\w+)\) )?return (.*?);", body, re.DOTALL)
                defined.append(
                    form + " : ".join(squeezed(f"{when} ? {value}" if when else value) for when, value in returned)
                )
    return f"{amount} = {', '.join(defined)}" if defined else amount


def warp_barriers(files: dict[str, str]) -> Barriers:
    """Hopper's barriers of some warps of a CTA."""
    found: Barriers = {}
    whole = "\n".join(files.values())
    for file, text in files.items():
        for function, body in functions(file, text):
            sites = [
                (kind, name, warps) for kind, name, warps in re.findall(r"\b(sync|arrive)<([A-Z_]+), ([^>]+)>", body)
            ]
            sites += [(kind, "CONSUMERS_MEET", "W") for kind in re.findall(r"\bconsumers_(sync|arrive)\b", body)]
            for statement in re.findall(r'"bar\.sync[^;]*;', body):
                name = re.findall(r"[A-Z]{3}[A-Z_]+", statement)[0]
                threads = re.search(r"%0, (\d+)", statement)
                warps = str(int(threads[1]) // 32) if threads else re.findall(r'"n"\((.*) \* 32\)', statement)[0]
                sites.append(("sync", name, warps.split('"n"(')[-1]))
            for kind, name, warps in sites:
                if name != "BARRIER" and not function.startswith("consumers_"):
                    if name not in found:
                        number = re.search(rf"(?:#define {name} |\b{name} = )(\d+)", whole)
                        found[name] = Barrier(count=number[1] if number else "none")
                    one = found[name]
                    (one.waits if kind == "sync" else one.arrives)[f"{function}({warps})"] += 1
            for name in ("__syncthreads", "cluster_exchange"):
                if times := len(re.findall(rf"\b{name}\(\)", body)):
                    found.setdefault(name, Barrier()).waits[function] += times
    return found


def callers(files: dict[str, str], name: str) -> Counter[str]:
    """Who calls a function that waits or arrives for others, with what beside the CTA: "few/project(0)"."""
    found: Counter[str] = Counter()
    for file, text in files.items():
        for function, body in functions(file, text):
            for call in re.finditer(rf"(?<![\w.>]){name}\(", body):
                given = arguments(body, call.end() - 1)[1:]
                found[f"{function}({', '.join(given)})"] += 1
    return found


def entries(text: str) -> dict[str, dict[str, str]]:
    """{name: {"": what stands behind it, field: its text}} of a table in comments."""
    found: dict[str, dict[str, str]] = {}
    last = name = ""
    for line in text.splitlines():
        if head := re.fullmatch(r"// ([\w:]+): (.*)", line):
            name, last = head[1], ""
            found[name] = {"": head[2]}
        elif part := re.fullmatch(r"//   (\w+) +(.*)", line):
            last = part[1]
            found[name][last] = part[2]
        elif more := re.fullmatch(r"//            (\S.*)", line):
            found[name][last] += f" {more[1]}"
    return found


def places(text: str) -> Counter[str]:
    found: Counter[str] = Counter()
    for place in filter(None, text.split("; ")):
        name, _, times = place.rstrip(";").partition(" ×")
        found[name] += int(times or 1)
    return found


@dataclass(frozen=True)
class Tables:
    """barriers.cu: of mbarriers, of those of a CTA's warps, and who calls the functions that wait or arrive."""

    mbarriers: Barriers
    callers: dict[str, Counter[str]]
    of_warps: Barriers

    @classmethod
    def read(cls, text: str) -> "Tables":
        _, own, called, warps = re.split(r"^// ---- .*$", text, flags=re.MULTILINE)
        known = {name: places(one[""]) for name, one in entries(re.sub(r"\n//  +", " ", called)).items()}
        return cls(barriers(own), known, barriers(warps))


def barriers(text: str) -> Barriers:
    found = {}
    for name, one in entries(text).items():
        if name not in ("count", "bytes", "arrives", "waits", "number"):
            assert one["who"] and one["guards"], name
            count = one.get("count", one.get("number", ""))
            found[name] = Barrier(count, one.get("bytes", ""), places(one.get("arrives", "")), places(one["waits"]))
    return found


@pytest.fixture(scope="module")
def files() -> dict[str, str]:
    return read(FOLDER)


def differing(files: dict[str, str]) -> list[str]:
    """The names of barriers, and of functions that wait or arrive, of which the tables say something else."""
    tables, found = Tables.read(files["barriers"]), []
    for table, in_code in ((tables.mbarriers, mbarriers(files)), (tables.of_warps, warp_barriers(files))):
        found += [name for name in table.keys() | in_code.keys() if table.get(name) != in_code.get(name)]
    found += [name for name, known in tables.callers.items() if known != callers(files, name)]
    return sorted(found)


def test_the_tables_say_what_the_code_does(files: dict[str, str]) -> None:
    tables = Tables.read(files["barriers"])
    for table, in_code in ((tables.mbarriers, mbarriers(files)), (tables.of_warps, warp_barriers(files))):
        for name in table.keys() | in_code.keys():
            said, done = table.get(name), in_code.get(name)
            assert said == done, f"{name}: barriers.cu says {said}, the code {done}: change the wrong one"
    assert tables.callers == {name: callers(files, name) for name in tables.callers}


def test_no_other_function_has_a_barriers_instruction(files: dict[str, str]) -> None:
    tables = Tables.read(files["barriers"])
    known = {*PRIMITIVES}
    for one in (*tables.mbarriers.values(), *tables.of_warps.values()):
        known |= {place.partition("(")[0] for place in one.arrives | one.waits}
    for file, text in files.items():
        with_one = {function for function, body in functions(file, text) if re.search(INSTRUCTIONS, body)}
        assert with_one <= known


@pytest.mark.parametrize(
    ("file", "text", "planted", "named"),
    [
        ("kernel", "barrier_init(b.empty(i), W)", "barrier_init(b.empty(i), W - 1)", "empty"),
        ("many/loop", "barrier_init(b.bar(BAR_DONE), W)", "barrier_init(b.bar(BAR_DONE), S)", "BAR_DONE"),
        ("many/loop", "1 + b.qn()", "b.qn()", "BAR_COMB"),
        ("kernel", "barrier_init(b.bar(BAR_GO), S)", "barrier_init(b.bar(BAR_GO), 1)", "BAR_GO"),
        ("few/project", "Q_EXPECT = HD * T * 2", "Q_EXPECT = HD * NT * 16", "BAR_Q"),
        ("combine", "receive(b, BAR_TOPS, b.n, TOPS_EXPECT", "receive(b, BAR_TOPS, b.n, X_EXPECT", "BAR_TOPS"),
        ("few/step", "barrier_wait(b.bar(BAR_GO), step & 1);", "", "BAR_GO"),
        ("few/step", "barrier_wait(b.bar(BAR_GO), step & 1)", "barrier_wait(b.bar(BAR_GO), 0)", "BAR_GO"),
        ("many/project", "    await_room(b);\n    send_queries", "    send_queries", "await_room"),
        ("many/project", "consumers_sync(), give_room(b);", "give_room(b);", "CONSUMERS_MEET"),
        ("many/attention", "sync<ROWS_HERE, W - SCORERS>();", "", "ROWS_HERE"),
        ("many/attention", "arrive<TOPS_FOR_ROWS, TOPS_FOR_ROWS_WARPS>();\n      arrive", "arrive", "TOPS_FOR_ROWS"),
        ("score", "sync<SUFFIX_SUMS, 4>", "sync<SUFFIX_SUMS, 5>", "SUFFIX_SUMS"),
        ("score", "WEIGHTS = 4,", "WEIGHTS = 5,", "WEIGHTS"),
        ("product", "      meet();", "      ;", "meet"),
        ("barriers", "BAR_RMS, BAR_RING", "BAR_RMS, BAR_NEW, BAR_RING", "BAR_NEW"),
    ],
)  # fmt: skip
def test_a_wrong_barrier_is_named(files: dict[str, str], file: str, text: str, planted: str, named: str) -> None:
    assert files[file].count(text) == 1, f"{file}.cu no longer has {text!r} once: update this planted fault"
    assert named in differing(files | {file: files[file].replace(text, planted)})


def test_a_barrier_that_has_no_name_is_an_error(files: dict[str, str]) -> None:
    planted = files["watch"].replace("prefetch(b, 0);", "prefetch(b, 0), barrier_wait(b.base + M_BAR, 0);")
    with pytest.raises(AssertionError, match="watch: a barrier without a name"):
        mbarriers(files | {"watch": planted})


def portable_barriers(files: dict[str, str]) -> tuple[list[str], dict[str, int]]:
    """What the portable kernel does in a step, in this order, and each function's barriers of its block."""
    events, in_block = [], {}
    for file, text in files.items():
        for function, body in functions(file, text):
            if times := len(re.findall(r"__syncthreads\(\)", body)):
                in_block[function] = times
            if function == "turbopi_portable_denoise":
                names = "arrive|wait|embed|combine|advance|attend|attend_across|product\\.run"
                events = re.findall(rf"\b(?:grid\.)?({names})\(", body)
    return events, in_block


def test_the_portable_tables_say_what_the_code_does() -> None:
    files = read(PORTABLE)
    phases, in_block = files["kernel"].partition("// of a block's warps")[0::2]
    rows = {name: one for name, one in entries(phases.partition("// in a step")[2]).items() if "guards" in one}
    assert tuple(sorted(rows)) == tuple(sorted(portable.PHASES)) and all(one["guards"] for one in rows.values())
    events = [event for one in rows.values() for event in one[""].split("; ")]
    counts = {name: int(one[""]) for name, one in entries(in_block).items() if one.get("guards")}
    assert (events, counts) == portable_barriers(files)
    parts = ("product", "attention", "attention_by_warps")
    waiting = {name for part in parts for name, body in functions(part, files[part]) if "grid.wait()" in body}
    assert waiting == {"Product::run", "attend", "attend_by_warps"}, "what `product.run` and `attend` wait for"
    assert "expected += phases * BLOCKS;" in files["primitives"] and '"r"(phases)' in files["primitives"]
    assert "while (arrived < expected)" in files["primitives"]


def test_of_two_phases_that_are_one_blocks_arrive_at_both() -> None:
    files = read(PORTABLE)
    across = dict(functions("attention_by_warps", files["attention_by_warps"]))["attend_across"]
    assert across.count("product.run(grid, ") == 1, "where it waits for other blocks"
    before = across.partition("product.run(")[0]
    assert not re.search(r"args\.(queries|keys|values|stream|squares|x)\b", before)
    assert re.search(r"attend_across\([^;]*;\s*grid\.arrive\(2\);", files["kernel"])


@pytest.mark.parametrize(
    ("file", "text", "planted"),
    [
        ("kernel", "          grid.wait();\n          combine", "          combine"),
        ("kernel", "        grid.arrive();\n        ahead<GateUpShape>", "        ahead<GateUpShape>"),
        ("kernel", "        grid.arrive(2);\n", ""),
        ("attention_by_warps", "  if (!busy) return;\n  __syncthreads();", "  if (!busy) return;"),
        ("attention", "    __syncthreads();\n    softmax", "    softmax"),
    ],
)  # fmt: skip
def test_a_portable_barrier_that_is_missing_is_seen(file: str, text: str, planted: str) -> None:
    files = read(PORTABLE)
    assert files[file].count(text) == 1
    assert portable_barriers(files) != portable_barriers(files | {file: files[file].replace(text, planted)})
