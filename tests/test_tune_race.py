"""How the tuner decides: fake operations with fake clocks, no GPU."""

from collections.abc import Mapping, Sequence

import pytest

from turbopi.kernels.tile_table import NO_TILES, Knobs, TileKey, TileTable
from turbopi.support.errors import DeviceLost
from turbopi.tune import race as racing
from turbopi.tune.race import FINALISTS, MARGIN, Round, Timed, UsualFails, race, winner
from turbopi.tune.run import Measured, Outcome, Planned, Progress, gained_ms, tune, tuned_tile
from turbopi.tune.shapes import Operation

EXACT = 0.001
NAN = float("nan")


class FakeBench:
    """times: what each tile takes, by its columns, or a list of them, one a round. Tiles are told by their columns."""

    bound, margin = 0.01, MARGIN

    def __init__(
        self,
        times: Mapping[int, float | list[float]],
        errors: Mapping[int, float] | None = None,
        broken: Mapping[int, str] | None = None,
    ) -> None:
        self.times, self.errors, self.broken = times, errors or {}, broken or {}
        self.order: list[int] = []

    def prepare(self, candidates: Sequence[Knobs]) -> Mapping[int, str]:
        return {
            i: self.broken[knobs["columns"]] for i, knobs in enumerate(candidates) if knobs["columns"] in self.broken
        }

    def error(self, knobs: Knobs) -> float:
        return self.errors.get(knobs["columns"], EXACT)

    def timer(self, knobs: Knobs) -> Round:
        columns = knobs["columns"]
        rounds = 0

        def measure() -> float:
            nonlocal rounds
            self.order.append(columns)
            taken = self.times[columns]
            rounds += 1
            return taken if isinstance(taken, int | float) else taken[(rounds - 1) % len(taken)]

        return measure


def tiles(*columns: int) -> list[dict[str, int]]:
    return [{"rows": 64, "columns": one} for one in columns]


def test_the_fastest_wins() -> None:
    raced = race(FakeBench({1: 10.0, 2: 9.0, 3: 8.0, 4: 12.0}), tiles(1, 2, 3, 4))
    assert (raced.best.knobs["columns"], raced.best.microseconds) == (3, 8.0)
    assert (raced.usual.knobs["columns"], raced.usual.microseconds, raced.timed) == (1, 10.0, 4)


@pytest.mark.parametrize("error", [0.0101, 1.0, float("inf"), NAN])
def test_a_wrong_result_never_wins_however_fast_and_isnt_timed(error: float) -> None:
    bench = FakeBench({1: 10.0, 2: 1.0, 3: 9.0}, {2: error})
    raced = race(bench, tiles(1, 2, 3))
    assert raced.best.knobs["columns"] == 3 and 2 not in bench.order
    assert "finite" in raced.refused[1] or "at most 0.01 is right" in raced.refused[1]


def test_what_does_not_compile_or_run_is_named_and_the_rest_goes_on() -> None:
    class Crashing(FakeBench):
        def error(self, knobs: Knobs) -> float:
            if knobs["columns"] == 3:
                raise RuntimeError("first line\n  out of resources  \n")
            return EXACT

    raced = race(Crashing({1: 10.0, 4: 9.0}, broken={2: "ptxas fails"}), tiles(1, 2, 3, 4))
    assert raced.refused == {1: "ptxas fails", 2: "out of resources"} and raced.best.knobs["columns"] == 4


def test_a_gpu_that_fails_for_good_ends_it() -> None:
    class Lost(FakeBench):
        def error(self, knobs: Knobs) -> float:
            raise DeviceLost("the GPU failed")

    with pytest.raises(DeviceLost):
        race(Lost({1: 10.0}), tiles(1))


@pytest.mark.parametrize("bench", [FakeBench({}, broken={1: "no"}), FakeBench({}, errors={1: 1.0})])
def test_without_the_usual_tile_there_is_nothing_to_compare_with(bench: FakeBench) -> None:
    with pytest.raises(UsualFails, match=r"the usual tile .* fails"):
        race(bench, tiles(1))


def test_candidates_take_turns_in_every_round() -> None:
    bench = FakeBench({1: 10.0, 2: 9.0, 3: 8.0})
    race(bench, tiles(1, 2, 3))
    rounds = [tuple(bench.order[at : at + 3]) for at in range(0, len(bench.order), 3)]
    assert len(rounds) == racing.ROUNDS + racing.FINAL_ROUNDS
    assert {*rounds[: racing.ROUNDS]} == {(1, 2, 3), (3, 2, 1)} and all({*one} == {1, 2, 3} for one in rounds)


def test_a_clock_that_falls_hits_all_alike() -> None:
    """Every tile takes twice as long in the second half; the faster one is still found, by its own share."""
    slower = [1.0] * racing.ROUNDS + [1.0] * (racing.FINAL_ROUNDS // 2) + [2.0] * (racing.FINAL_ROUNDS // 2 + 1)
    raced = race(FakeBench({1: [10 * one for one in slower], 2: [9 * one for one in slower]}), tiles(1, 2))
    assert raced.best.knobs["columns"] == 2
    assert raced.best.microseconds / raced.usual.microseconds == pytest.approx(0.9)


def test_a_gain_within_the_noise_leaves_the_usual_tile() -> None:
    usual = Timed({"columns": 1}, 10.0, 0.0)
    rows = {0: usual, 1: Timed({"columns": 2}, 9.95, 0.0)}
    assert winner(rows, 0.01) == usual and winner(rows, 0.003).knobs["columns"] == 2


def test_only_the_best_of_many_run_the_final_with_the_usual_one() -> None:
    bench = FakeBench({1: 100.0, **{column: float(column) for column in range(2, 30)}})
    raced = race(bench, tiles(1, *range(2, 30)))
    assert {*bench.order[29 * racing.ROUNDS :]} == {1, *range(2, 2 + FINALISTS)}
    assert raced.best.knobs["columns"] == 2 and raced.timed == 29


def test_one_late_round_decides_nothing() -> None:
    raced = race(FakeBench({1: [10.0], 2: [9.0, 9.0, 9.0, 9000.0, 9.0]}), tiles(1, 2))
    assert raced.best.knobs["columns"] == 2 and raced.best.microseconds == 9.0


def test_times_that_scatter_are_called_busy() -> None:
    assert racing.busy([racing.spread([10.0, 14.0] * 10)]) and not racing.busy([racing.spread([10.0, 10.1] * 10)])


# ---- several operations


def operation(rows: int = 576) -> Operation:
    return Operation("prefix qkv", "portable", "plain", "fp8", rows, 2560, 2048, 17)


def planned(*rows: int) -> list[Planned]:
    return [Planned(operation(one), tiles(1, 2)) for one in rows]


def good(_: Operation, tiles: TileTable = NO_TILES) -> FakeBench:
    return FakeBench({1: 10.0, 2: 9.0})


def test_what_is_found_is_kept_after_each_operation_so_that_a_later_failure_loses_nothing() -> None:
    kept: list[list[int]] = []

    def make(one: Operation, _: TileTable) -> FakeBench:
        if one.rows == 640:
            raise DeviceLost("the GPU failed")
        return good(one)

    with pytest.raises(DeviceLost):
        tune(planned(512, 576, 640), make, lambda found: kept.append([one.operation.rows for one in found]))
    assert kept == [[512], [512, 576]]


def test_no_operation_begins_when_time_is_up() -> None:
    now = 0.0

    def make(one: Operation, _: TileTable) -> FakeBench:
        nonlocal now
        now += 40
        return good(one)

    outcome = tune(planned(512, 576, 640, 704), make, lambda found: None, seconds=75, clock=lambda: now)
    assert [one.operation.rows for one in outcome.measured] == [512, 576]
    assert [one.rows for one in outcome.left_out] == [640, 704]


def test_an_operation_whose_usual_tile_fails_is_named_and_the_others_are_measured() -> None:
    outcome = tune(
        planned(512, 576), lambda one, _: good(one) if one.rows == 576 else FakeBench({}, {1: 1.0}), lambda found: None
    )
    assert [one.operation.rows for one in outcome.measured] == [576]
    assert [what.rows for what in outcome.failed] == [512]


def test_progress_is_told_of_operations_candidates_and_results() -> None:
    reported: list[object] = []
    progress = Progress(
        lambda text, total: reported.append((text, total)),
        lambda: reported.append("."),
        lambda one: reported.append(one.gained),
    )
    outcome: Outcome = tune(planned(512), good, lambda found: None, progress=progress)
    assert reported == [("1/1 prefix qkv, fp8, 512 rows", 2), ".", ".", 1.0] and len(outcome.measured) == 1


def test_an_operation_is_timed_beside_what_was_found_before_it() -> None:
    elsewhere = TileKey("portable", "geglu", "fp8", 576, 16384, 2048)
    seen: list[TileTable] = []

    def make(one: Operation, tiles: TileTable) -> FakeBench:
        seen.append(tiles)
        return good(one)

    tune(planned(512, 576, 640), make, lambda found: None, tiles=TileTable({elsewhere: {"columns": 8}}))
    assert [len(tiles) for tiles in seen] == [1, 2, 3]
    assert seen[2].tiles == {elsewhere: {"columns": 8}} | {operation(rows).key: tiles(2)[0] for rows in (512, 576)}


def test_layers_in_which_several_operations_are_timed_are_counted_once() -> None:
    def measured(name: str, rows: int, usual: float, best: float) -> Measured:
        one = Operation(name, "hopper", "plain", "fp8", rows, 2560, 1024, 100)
        return Measured(one, racing.Raced(Timed({}, usual, 0.0), Timed({}, best, 0.0), 2, {}))

    found = [measured("expert qkv", 64, 30.0, 29.0), measured("expert out", 128, 29.0, 28.0)]
    found.append(measured("prefix qkv", 192, 50.0, 45.0))
    kept = {one.operation.key: tuned_tile(one) for one in found}
    assert gained_ms(kept, [one.operation for one in found]) == pytest.approx((8.0, 0.7, 0))
    assert gained_ms({}, [one.operation for one in found]) == (0, 0, 3)
