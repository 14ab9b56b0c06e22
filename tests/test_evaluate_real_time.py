"""Episodes in real time. The clock is set by hand here, so that nothing depends on how fast a machine is."""

import json
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli_helpers import turbopi
from evaluate_fakes import SeekingPolicy, run

from turbopi.evaluate.checks import check_delay
from turbopi.evaluate.delays import Cell, document, heads, make_cells, row, write_delays
from turbopi.evaluate.episode import Ending, Execution, NoActions
from turbopi.evaluate.frames import Frame
from turbopi.evaluate.pacing import Paced, Pacer, allows_for_lateness, rate_given, summarise_paced
from turbopi.evaluate.plan import Job, Protocol
from turbopi.evaluate.reading import load_results
from turbopi.evaluate.real_time import _STEP, RealTimeLoop, Unfit, _Policy
from turbopi.evaluate.results import protocol_json
from turbopi.realtime import WAYS
from turbopi.sim import create
from turbopi.sim.base import Task
from turbopi.support.errors import ConfigError

pytestmark = pytest.mark.usefixtures("two_layers", "unseen_plots")

HZ, STEP = 20.0, 1 / 20
TASK = Task(0, "count", "count", 10, 60)
OFFERED = {"modes": ["rtc", "rtc_identity", "rtc_trained", "warm_start", "paint"], "trained_max_delay": 4}


class Clock:
    """Time passes when somebody sleeps, or computes. Answers that are due by then have come."""

    def __init__(self) -> None:
        self.now = 100.0
        self.due: list[tuple[float, Callable[[], None]]] = []

    def __call__(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        assert seconds > 0
        self.now += seconds
        ready = [give for when, give in self.due if when <= self.now]
        self.due = [one for one in self.due if one[0] > self.now]
        for give in ready:
            give()


class Inference:
    """Computes at once; the answer is there `seconds` of the clock later. Who waits for it makes the time pass."""

    def __init__(self, clock: Clock) -> None:
        self.clock, self.seconds = clock, 0.0
        self.warming: Callable[[], bool] = lambda: False

    def begin(self, call: Callable[[], Any]) -> "Future[Any]":
        future: Future[Any] = Waited(self.clock)
        if self.warming():  # on another thread, as whoever asks holds the executor's lock
            threading.Thread(target=lambda: _answer(future, call)).start()
            return future
        computed: Future[Any] = Future()
        _answer(computed, call)
        self.clock.due.append((self.clock.now + self.seconds, lambda: _answer(future, computed.result)))
        return future

    def close(self, timeout_s: float) -> bool:
        return True


def _answer(future: "Future[Any]", call: Callable[[], Any]) -> None:
    try:
        future.set_result(call())
    except BaseException as error:
        future.set_exception(error)


class Waited(Future[Any]):
    def __init__(self, clock: Clock) -> None:
        super().__init__()
        self._clock = clock

    def result(self, timeout: float | None = None) -> Any:
        while not self.done() and self._clock.due:
            self._clock.sleep(max(1e-9, min(when for when, _ in self._clock.due) - self._clock.now))
        return super().result(timeout)


class World:
    """Counts its steps; each takes `seconds` of the clock. Its state is the count of actions that weren't standing."""

    def __init__(self, clock: Clock, seconds: float = 0.0, solved_at: int = 1000) -> None:
        self.clock, self.seconds, self.solved_at = clock, seconds, solved_at
        self.actions: list[float] = []
        self.times: list[float] = []
        self.seen = True

    def reset(self, initial_state: int) -> None:
        self.actions, self.times, self.seen = [], [], True

    def observation(self) -> dict[str, Any]:
        assert self.seen, "the step before took no images"
        return {"image": np.full((2, 2, 3), len(self.actions), np.uint8), "count": len(self.actions)}

    def step(self, action: np.ndarray, look: bool) -> bool:
        self.times.append(self.clock.now)
        self.actions.append(float(action[0]))
        self.seen = look
        if self.seconds:
            self.clock.sleep(self.seconds)
        return len(self.actions) >= self.solved_at

    def draw(self) -> list[np.ndarray]:
        return [np.full((2, 2, 3), len(self.actions), np.uint8)]

    def close(self) -> None:
        pass


class Setup:
    """A loop around a policy whose chunks' row i is 100 * (when it was asked) + i, H = 12."""

    def __init__(
        self, way: str, *, policy_s: float, every: int = 4, hz: float = HZ, warm_s: float | None = None
    ) -> None:
        self.clock = Clock()
        self.inference = Inference(self.clock)
        self.requested: list[tuple[int | None, dict[str, Any], Mapping[str, Any]]] = []
        self.trouble: dict[int, BaseException] = {}  # by step
        self.slow: dict[int, float] = {}  # by step
        self.policy_s, self.warm_s = policy_s, policy_s if warm_s is None else warm_s
        self.loop = RealTimeLoop(
            self.ask, OFFERED, Execution(way, every, 0, lambda last: np.full(2, -1.0)), hz,
            action_dim=2, clock=self.clock, sleep=self.clock.sleep, inference=self.inference,
        )  # fmt: skip
        self.inference.warming = lambda: not self.loop._warm

    def ask(self, step: int | None, observation: dict[str, Any], arguments: Mapping[str, Any]) -> dict[str, Any]:
        self.requested.append((step, observation, arguments))
        self.inference.seconds = self.policy_s if step is None else self.slow.get(step, self.policy_s)
        if step is None:
            self.clock.now += self.warm_s
        elif step in self.trouble:
            raise self.trouble[step]
        rows = 100.0 * observation["count"] + np.arange(12.0)
        chunk = np.stack([rows, np.zeros(12)], axis=1)
        return {"actions": chunk, "model_actions": chunk.astype(np.float32)}

    def run(self, world: World, steps: int = 20, **more: Any) -> Ending:
        return self.loop.run(world, Job(TASK, 0), max_steps=steps, image_keys=("image",), **more)


# --- the clock --------------------------------------------------------------------------------------------------------


def test_steps_are_due_at_the_rate_whatever_their_own_time_is() -> None:
    setup = Setup("async", policy_s=0.01)
    world = World(setup.clock, seconds=0.03)
    ending = setup.run(world, steps=10)
    assert np.diff(world.times) == pytest.approx([STEP] * 9)
    assert ending.paced is not None and ending.paced.late_ms == [] and ending.paced.step_ms == pytest.approx((30, 30))
    assert ending.paced.seconds == pytest.approx(9 * STEP)


def test_a_simulator_that_is_too_slow_is_late_and_the_clock_does_not_wait_for_it() -> None:
    setup = Setup("async", policy_s=0.01)
    world = World(setup.clock, seconds=0.06)
    paced = setup.run(world, steps=10).paced
    assert paced is not None
    assert paced.late_ms == pytest.approx([10 * step for step in range(1, 10)])  # 10 ms more with each step
    reported = summarise_paced([(10, paced)], HZ)
    assert reported is not None and not reported.is_real_time and reported.late_steps == 9
    assert reported.speed == pytest.approx(50 / 60, abs=1e-3) and reported.longest_step_ms == pytest.approx(60)
    text = allows_for_lateness(reported, HZ)
    assert text is not None and text.startswith("NOT REAL TIME. 9 of 10 control steps (90 %) began late, by 50.0 ms")
    assert "took 60.0 ms, where 20 Hz leaves 50.0 ms for one; the world's time ran at 0.833 of the clock's" in text


def test_one_slow_step_is_caught_up_with() -> None:
    clock = Clock()
    pacer, began = Pacer(HZ, clock, clock.sleep), clock.now
    starts = []
    for own in (0.01, 0.12, 0.01, 0.01, 0.01):
        pacer.wait()
        starts.append(clock.now - began)
        clock.sleep(own)
    assert starts == pytest.approx([0, 0.05, 0.17, 0.18, 0.20])  # the last one is at its own time again
    assert pacer.late_ms == pytest.approx([70, 30])
    assert pacer.seconds == pytest.approx(0.2)


def test_a_sleep_that_ends_early_is_slept_on() -> None:
    clock = Clock()
    pacer = Pacer(HZ, clock, lambda seconds: clock.sleep(seconds / 2 + 1e-3))
    pacer.wait()
    pacer.wait()
    assert clock.now >= 100 + STEP and not pacer.late_ms


def test_a_machine_that_wakes_late_is_late_whoever_is_to_blame() -> None:
    def starts(oversleeps: float) -> Pacer:
        clock = Clock()
        pacer = Pacer(HZ, clock, lambda seconds: clock.sleep(seconds + oversleeps))
        for _ in range(3):
            pacer.wait()
        return pacer

    assert starts(0.004).late_ms == []  # a tenth of a step is no matter
    assert starts(0.02).late_ms == pytest.approx([20, 20])


def test_few_late_steps_are_told_and_many_make_it_no_real_time() -> None:
    def reported(late: int) -> str | None:
        paced = Paced([1], [20.0], {}, [4.0] * late, (10.0, 54.0), 199 * STEP)
        summary = summarise_paced([(200, paced)], HZ)
        assert summary is not None
        return allows_for_lateness(summary, HZ)

    assert reported(0) is None
    assert str(reported(2)).startswith("2 of 200 control steps (1 %) began late, by 4.0 ms in the median")
    assert str(reported(3)).startswith("NOT REAL TIME.")


def test_slow_motion_is_said() -> None:
    assert rate_given(20, 20) == "20 control steps a second"
    assert rate_given(10, 20) == "10 control steps a second, where the simulator's robot makes 20: slow motion"
    assert rate_given(50, 20).endswith("fast motion")


# --- the ways to run --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("way", ["async", "rtc", "rtc_identity", "rtc_trained"])
@pytest.mark.parametrize("policy_s", [0.02, 0.12])
def test_the_delay_is_the_policys_time_in_control_steps(way: str, policy_s: float) -> None:
    """A call that ends within a control step takes effect at the next one: a delay of 1."""
    setup = Setup(way, policy_s=policy_s)
    world = World(setup.clock, seconds=0.01)
    ending = setup.run(world)
    delay = 1 if policy_s < STEP else 3
    # The robot stands still until the first chunk is there, then carries out 4 actions, asks, and goes on for the delay
    first = [-1.0] * delay + [float(row) for row in range(4 + delay)]
    second = 100.0 * (4 + delay) + np.arange(delay, 4 + delay)
    assert world.actions[: len(first) + 4] == [*first, *second]
    assert ending.paced is not None and set(ending.paced.delays) == {delay} and not ending.paced.dropped
    assert ending.motion is not None and ending.motion.standing == delay
    assert ending.commands.seams[0] == len(first) and ending.motion.seams == len(ending.commands.seams)
    assert ending.motion.seam_jump == pytest.approx(second[0] - first[-1], rel=0.5)
    reported = [arguments["previous"] for step, _, arguments in setup.requested if step is not None and arguments]
    if way == "async":
        assert not reported
    else:
        assert reported[0] is None and all(one.delay == delay and one.mode == way for one in reported[1:])


def test_sync_stands_still_while_the_policy_computes() -> None:
    setup = Setup("sync", policy_s=0.07)
    world = World(setup.clock, seconds=0.01)
    ending = setup.run(world, steps=12)
    assert world.actions == [-1, -1, 0, 1, 2, 3, -1, -1, 600, 601, 602, 603]
    assert ending.motion is not None and ending.motion.standing == 4


def test_every_way_runs_and_ensemble_averages() -> None:
    for way in WAYS:
        ending = Setup(way, policy_s=0.02).run(World(Clock()), steps=12)
        assert ending.steps == 12 and ending.paced is not None and ending.paced.delays
    setup = Setup("ensemble", policy_s=0.02)
    world = World(setup.clock)
    setup.run(world, steps=12)
    assert world.actions[6] == pytest.approx(0.3 * 5 + 0.7 * 501)  # as of a chunk that was asked for after 5 steps


def test_a_chunk_that_comes_later_than_told_is_dropped_and_counted() -> None:
    setup = Setup("rtc_trained", policy_s=0.02)
    setup.slow = {5: 0.12}  # where a delay of 1 was to be expected
    world = World(setup.clock)
    ending = setup.run(world, steps=20)
    assert ending.paced is not None
    assert ending.paced.dropped == {"late": 1} and ending.paced.delays == [1, 3, 1, 1, 1]
    assert world.actions[1:10] == [0, 1, 2, 3, 4, 5, 6, 7, 801]  # of the chunk that was asked for instead, at step 8
    assert ending.motion is not None and ending.motion.dropped == 1


def test_a_policy_too_slow_for_the_way_is_refused_before_the_robot_moves() -> None:
    setup = Setup("rtc", policy_s=0.5)
    world = World(setup.clock)
    with pytest.raises(Unfit, match=r"one call takes 500 ms, 10 control steps at 20 Hz: .*lower control_hz"):
        setup.run(world)
    assert not world.actions
    assert Setup("rtc", policy_s=0.5, hz=4).run(World(Clock())).status == "failure"  # slow motion is slow enough


def test_the_warm_up_is_no_part_of_what_is_measured_and_happens_once() -> None:
    setup = Setup("async", policy_s=0.02, warm_s=3.0)
    for episode in range(2):
        ending = setup.run(World(setup.clock), steps=9)
        assert ending.paced is not None and max(ending.paced.delays) == 1 and ending.paced.late_ms == []
        assert sum(step is None for step, _, _ in setup.requested) == 3, episode
    assert [step for step, _, _ in setup.requested[3:]] == [0, 5, 0, 5]  # from each first observation on
    assert all(set(observation) == {"image", "count"} for _, observation, _ in setup.requested)


def test_an_episode_is_not_given_the_answer_of_the_one_before() -> None:
    setup = Setup("async", policy_s=0.12)
    world = World(setup.clock)
    first = setup.run(world, steps=8)  # ends while a chunk is computed
    assert first.paced is not None and len(first.paced.delays) == 1 and len(setup.requested) == 3 + 2
    second = setup.run(world, steps=8)
    assert world.actions == [-1, -1, -1, 0, 1, 2, 3, 4]
    assert second.paced is not None and second.paced.delays == [3] and second.paced.dropped == {}


def test_actions_that_cannot_be_used_are_dropped_as_on_a_robot() -> None:
    setup = Setup("async", policy_s=0.02)
    setup.trouble = {5: NoActions("the model computed nan")}
    ending = setup.run(World(setup.clock), steps=12)
    assert ending.status == "failure" and ending.paced is not None and ending.paced.dropped == {"failed": 1}
    assert [step for step, _, _ in setup.requested[3:]] == [0, 5, 6, 10]  # asked again with the next observation


def test_latency_is_from_the_observation_to_the_policys_answer() -> None:
    clock = Clock()

    def ask(step: int | None, observation: dict[str, Any], arguments: Mapping[str, Any]) -> dict[str, Any]:
        clock.now += 0.25 if step is None else 0.03
        return {"actions": np.zeros((12, 2))}

    policy = _Policy(ask, {}, clock)
    for observation in ({}, {_STEP: 0}, {_STEP: 5}):
        policy.infer(observation)
    assert policy.latency_ms == pytest.approx([30, 30])  # but for the warm-up


def test_a_policy_that_is_gone_ends_the_episode() -> None:
    setup = Setup("async", policy_s=0.02)
    setup.trouble = {5: EOFError("the pipe is closed")}
    with pytest.raises(EOFError, match="the pipe is closed"):
        setup.run(World(setup.clock))


def test_an_episode_that_crashes_leaves_nothing_to_the_next_one() -> None:
    setup = Setup("async", policy_s=0.12)

    class Crashing(World):
        def step(self, action: np.ndarray, look: bool) -> bool:
            if len(self.actions) == 7:  # while the chunk of step 5's observation is computed
                raise RuntimeError("the physics exploded")
            return super().step(action, look)

    with pytest.raises(RuntimeError, match="the physics exploded"):
        setup.run(Crashing(setup.clock))
    assert setup.clock.due == []  # no call is under way, whose answer would be taken for another's
    setup.trouble = {0: EOFError("the policy's part of it")}
    with pytest.raises(EOFError):
        setup.run(World(setup.clock))
    setup.trouble = {}
    assert setup.run(World(setup.clock), steps=8).status == "failure"


def test_a_solved_task_ends_the_episode() -> None:
    setup = Setup("async", policy_s=0.02)
    ending = setup.run(World(setup.clock, solved_at=7))
    assert (ending.status, ending.steps, len(ending.commands.values)) == ("success", 7, 7)


def test_pictures_are_drawn_only_where_the_policy_may_look() -> None:
    setup = Setup("async", policy_s=0.02, every=6)
    looks: list[bool] = []

    class Watched(World):
        def step(self, action: np.ndarray, look: bool) -> bool:
            looks.append(look)
            return super().step(action, look)

    world = Watched(setup.clock)
    setup.run(world, steps=9)
    #        waits, then rows 0 to 5; row 6 runs while the chunk that is asked for before it is computed
    assert looks == [True, False, False, False, False, False, True, True, False]


def test_a_film_shows_what_was_carried_out() -> None:
    setup = Setup("async", policy_s=0.07)
    frames: list[Frame] = []
    setup.run(World(setup.clock), steps=10, on_frame=frames.append)
    assert [(frame.step, frame.entered, frame.planned, frame.done) for frame in frames] == [
        *((0, 0, 0, 0), (2, 0, 6, 0)),  # the robot waits for the first chunk; it takes over
        *((6, 0, 6, 4), (8, 2, 4, 2), (10, 2, 4, 4)),
    ]
    assert [frame.note[:6] for frame in frames] == ["stands", "", "the ne", "", ""]
    assert all(frame.camera_images[0][0, 0, 0] == frame.step for frame in frames)
    assert frames[3].before[:, 0].tolist() == [4, 5] and frames[3].chunk[0, 0] == 600


# --- a whole run ------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_run_in_real_time_is_another_run_and_says_what_it_measured(tmp_path: Path) -> None:
    assert "control_hz" not in protocol_json(Protocol("reacher", "reacher_colors"))
    cells = make_cells(["async", "sync"], [None], [4])
    assert [cell.folder for cell in cells] == ["async_real_time_horizon4", "sync_real_time_horizon4"]
    done = []
    for cell in cells:
        own: dict[str, Any] = {"replan": 4, "execution": cell.execution, "control_hz": 200.0, "max_steps": 30}
        done.append((cell, run(tmp_path / cell.folder, SeekingPolicy(), states=(0, 1), **own)))
    results = load_results(tmp_path / cells[0].folder)
    assert results.control_hz == 200 and all(
        e.real_time is not None and e.motion is not None for e in results.in_order()
    )
    assert all(len(e.call_ms) >= len(e.real_time.delays) for e in results.in_order() if e.real_time)
    reported = document(done)
    assert [cell.delay for cell in reported.cells] == [None, None] and reported.cells[1].against is not None
    assert heads(reported.cells)[-3:] == ("latency [ms] p50 / p95", "dropped", "late steps")
    assert all(len(row(cell)) == len(heads(reported.cells)) for cell in reported.cells)
    assert row(reported.cells[0])[1].startswith("measured: ")
    text = write_delays(tmp_path, done).read_text()
    assert "<b>In real time</b>, 200 control steps a second, where the simulator" in text and "fast motion" in text
    page = (tmp_path / cells[0].folder / "report.html").read_text()
    assert "delays are measured by the wall clock" in page
    with pytest.raises(ConfigError, match="control_hz"):
        run(tmp_path / cells[0].folder, SeekingPolicy(), states=(0,), replan=4, execution="async", max_steps=30)


def test_a_report_says_that_a_simulator_ran_late(tmp_path: Path) -> None:
    results = run(tmp_path, SeekingPolicy(), states=(0,), execution="async", control_hz=50.0, max_steps=5)
    (episode,) = results.in_order()
    late = Paced([1, 2], [20.0, 21.0], {"late": 1}, [7.0] * 4, (10.0, 27.0), 5 / 50)
    results.episodes[episode.key] = type(episode)(**{**_fields(episode), "real_time": late})
    write_delays(tmp_path, [(Cell("async", None, 5), results)])
    reported = json.loads((tmp_path / "delays.json").read_text())["cells"][0]["real_time"]
    assert reported["late_steps"] == 4 and reported["dropped"] == {"late": 1} and reported["delay_steps"]["p50"] == 1.5
    assert "async: NOT REAL TIME. 4 of" in (tmp_path / "delays.html").read_text()


def _fields(episode: Any) -> dict[str, Any]:
    return {name: getattr(episode, name) for name in episode.__struct_fields__}


def test_a_way_that_the_policy_is_too_slow_for_ends_the_run_with_the_reason(tmp_path: Path) -> None:
    class Joins(SeekingPolicy):
        """Offers joining, but its chunks are too short for any delay at all: H = 5 at an execution horizon of 5."""

        def __init__(self) -> None:
            super().__init__(horizon=5)
            self.metadata["real_time"] = {"modes": ["rtc"]}

        def infer_batch(self, observations: Any, seed: Any, **arguments: Any) -> Any:
            results = super().infer_batch(observations, seed)
            return [result | {"model_actions": result["actions"].astype(np.float32)} for result in results]

    with pytest.raises(ConfigError, match=r"--execution rtc can't be run in real time: one call takes .* lower"):
        run(tmp_path, Joins(), states=(0,), replan=5, execution="rtc", control_hz=20.0)


def test_a_protocol_in_real_time_has_no_simulated_delay_and_needs_a_robot_that_can_stand() -> None:
    with pytest.raises(ConfigError, match="a delay of 2 steps can't be simulated in real time"):
        Protocol("chase", "chase_post", delay=2, control_hz=20.0)
    with pytest.raises(ConfigError, match=r"control_hz=0.0 should be above 0, at most 10000"):
        Protocol("chase", "chase_post", control_hz=0.0)

    class Restless:
        name = "restless"

    with pytest.raises(ConfigError, match=r"restless doesn't say how its robot stands still .*in real time"):
        check_delay(Protocol("chase", "chase_post", control_hz=20.0), Restless(), 10)  # type: ignore[arg-type]
    check_delay(Protocol("chase", "chase_post", control_hz=20.0), create("chase"), 10)


@pytest.mark.parametrize(
    ("options", "why"),
    [
        ("--real-time --delay-steps 2", "--real-time measures the delay, and --delay-steps 2 simulates it"),
        ("--real-time --delay-steps 0", "--delay-steps 0 simulates it: give one of them"),
        ("--real-time --workers 2", "--real-time runs one episode at a time"),
        ("--real-time --smooth-videos", "draws at every control step"),
        ("--control-hz 10", "--control-hz is the rate of --real-time"),
        ("--real-time --control-hz -1", "--control-hz -1.0 should be above 0"),
        ("--real-time --control-hz 0", "--control-hz 0.0 should be above 0"),
    ],
)
def test_options_that_contradict_each_other_are_refused(options: str, why: str, tmp_path: Path) -> None:
    command = f"eval reacher --random-weights pi05_tiny {options} --out {tmp_path / 'never'}"
    result = turbopi(*command.split())
    assert result.exit_code == 2 and why in " ".join(result.stderr.split()), result.output
    assert not (tmp_path / "never").exists()


def test_compare_refuses_what_it_would_not_do() -> None:
    result = turbopi(*["compare", "pytorch:f32", "pytorch:bf16", "--real-time", "--execution", "rtc"])
    assert result.exit_code == 2 and "--execution, --real-time: ways to join chunks" in " ".join(result.stderr.split())


@pytest.mark.slow
def test_the_command_runs_in_real_time(tmp_path: Path) -> None:
    from turbopi.policy.shipped import CHASE_POLICY

    result = turbopi(
        "eval", "chase", CHASE_POLICY, "--trials", 1, "--max-steps", 8, "--videos", "none", "--camera-px", 48,
        "--execution", "async,rtc_trained", "--real-time", "--control-hz", 5, "--out", tmp_path, "--json",
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    cells = json.loads(result.stdout)["cells"]
    assert [(cell["execution"], cell["delay"]) for cell in cells] == [("async", None), ("rtc_trained", None)]
    assert all(cell["real_time"]["steps"] == 8 and cell["real_time"]["delay_steps"]["count"] >= 1 for cell in cells)
