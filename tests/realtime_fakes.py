"""A clock that is set by hand, a policy whose answers come when a test says so, and the control loop between them."""

import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from typing import Any

import numpy as np

from turbopi.realtime import Command, RealTimeExecutor

HZ = 50.0


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


class ByHand:
    """An inference that computes when `answer` is called."""

    def __init__(self) -> None:
        self.waiting: list[tuple[Callable[[], Any], Future[Any]]] = []
        self.at_once = False
        self.closed = False

    def begin(self, call: Callable[[], Any]) -> "Future[Any]":
        future: Future[Any] = Future()
        self.waiting.append((call, future))
        if self.at_once:
            threading.Thread(target=self.answer).start()  # for a caller that waits
        return future

    def answer(self) -> None:
        call, future = self.waiting.pop(0)
        try:
            future.set_result(call())
        except BaseException as error:
            future.set_exception(error)

    def close(self, timeout_s: float) -> bool:
        self.closed = True
        return not self.waiting


class LinePolicy:
    """Chunks that count on from the observed place; every call takes `seconds` of the clock. Joins chunks."""

    def __init__(self, clock: Clock, *, horizon: int = 10, seconds: float = 0.0, modes: tuple[str, ...] = ()) -> None:
        self.clock, self.horizon, self.seconds = clock, horizon, seconds
        self.metadata: dict[str, Any] = {"config": "line"}
        if modes:
            self.metadata["real_time"] = {"modes": list(modes), "trained_max_delay": 4}
        self.calls: list[dict[str, Any]] = []
        self.error: BaseException | None = None
        self.change: Callable[[dict[str, Any]], dict[str, Any]] = lambda result: result

    def infer(
        self, obs: Mapping[str, Any], *, previous: Any = None, model_actions: bool = False, **more: Any
    ) -> dict[str, Any]:
        self.calls.append({"obs": dict(obs), "previous": previous, "model_actions": model_actions, **more})
        self.clock.now += self.seconds
        if self.error is not None:
            raise self.error
        rows = (np.arange(self.horizon) + float(obs["place"]))[:, None]
        result: dict[str, Any] = {"actions": rows}
        if model_actions:
            result["model_actions"] = np.repeat(rows, 2, axis=1).astype(np.float32)
        return self.change(result)


class Loop:
    """A control loop: an observation before each command, at 50 Hz of the clock."""

    def __init__(self, executor: RealTimeExecutor, clock: Clock, hand: ByHand) -> None:
        self.executor, self.clock, self.hand = executor, clock, hand
        self.place = 0.0
        self.commands: list[Command] = []
        self._begun = 0  # the step of the last observation that was used

    def step(self, *, observe: bool = True, answer: bool = False, delay: int | None = None) -> Command:
        """A control step. `answer`: the policy answers before it; `delay`: so many steps after its observation."""
        if answer:
            self.hand.answer()
        self._answer_after(delay)
        if observe and self.executor.observe({"place": self.place}):
            self._begun = len(self.commands)
        self._answer_after(delay)
        command = self.executor.next_action()
        if command.kind == "fresh":
            assert command.action is not None
            assert abs(command.action[0] - self.place) < 1e-9, "an action was carried out twice, or left out"
            self.place += 1
        self.commands.append(command)
        self.clock.now += 1 / HZ
        return command

    def _answer_after(self, delay: int | None) -> None:
        if delay is not None and self.hand.waiting and len(self.commands) - self._begun >= delay:
            self.hand.answer()

    def run(self, steps: int, delay: int) -> None:
        """`steps` control steps in which every answer comes after `delay` of them."""
        for _ in range(steps):
            self.step(delay=delay)


def started(execution: Any = "async", *, warm: bool = True, **options: Any) -> tuple[Loop, LinePolicy]:
    """A loop around a warm executor."""
    clock, hand = Clock(), ByHand()
    modes = options.pop("modes", ("rtc", "rtc_identity", "rtc_trained", "warm_start", "paint"))
    policy = LinePolicy(clock, horizon=options.pop("horizon", 10), seconds=options.pop("seconds", 0.0), modes=modes)
    executor = RealTimeExecutor(
        policy,
        control_hz=HZ,
        execution=execution,
        clock=clock,
        inference=hand,
        **options,
    )
    if warm:
        hand.at_once = True
        executor.warm_up({"place": -1000.0})
        hand.at_once = False
        policy.calls.clear()
    return Loop(executor, clock, hand), policy
