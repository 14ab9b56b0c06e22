"""Turns a decoded message into requests for the policy, and their outcomes into the answer."""

import asyncio
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from turbopi.realtime.messages import PREFIX
from turbopi.serve.calls import Calls
from turbopi.serve.connection import GuardedConnection
from turbopi.serve.options import ServerOptions
from turbopi.serve.outcome import Outcome
from turbopi.serve.real_time import Plan, RealTime
from turbopi.serve.rows import TIMING, check_rows, row, stacked, summed
from turbopi.serve.scheduling.schedule import Request
from turbopi.serve.urgency import Urgency, check_batch, read_urgency
from turbopi.support.errors import ObservationError


@dataclass(frozen=True)
class Asking:
    """What a message asks for. Give it to `Askings.release` once its outcomes are there."""

    plan: Plan
    urgency: Urgency

    @property
    def rows(self) -> int | None:
        """B of a batch message; None: one observation."""
        return self.urgency.rows


class Askings:
    """For one policy. For the event loop's thread alone.

    strict  a batch message above the largest batch that was measured is refused instead of split
    """

    def __init__(self, calls: Calls, real_time: RealTime, options: ServerOptions, *, strict: bool) -> None:
        self._calls, self._real_time, self._options, self._strict = calls, real_time, options, strict

    def read(self, received: Mapping[str, Any], connection: GuardedConnection) -> Asking:
        """Raises ObservationError for what can't be meant."""
        urgency = read_urgency(received, self._options.deadline_ms, self._options.control_hz)
        if urgency.rows is None:
            return Asking(self._real_time.plan(received, connection), urgency)
        check_batch(received, joins=self._options.execution is not None)
        largest = self._calls.largest
        if self._strict and urgency.rows > largest:
            raise ObservationError(
                f"{PREFIX}batch is {urgency.rows}, and the largest batch that warm-up covered is {largest}: a server "
                "with --strict splits none. Send smaller ones, or start it with a larger --max-batch"
            )
        plan = self._real_time.plan(received, connection)
        check_rows(plan.observation, urgency.rows)
        return Asking(plan, urgency)

    def ask(self, asking: Asking, connection: GuardedConnection, arrived: float) -> "asyncio.Future[list[Outcome]]":
        """An outcome of each row, as `Calls.ask` and `ask_rows` give it. It is in the line at once."""
        plan, urgency = asking.plan, asking.urgency

        def request(rows: int, later: int) -> Request:
            first = rows + later == (urgency.rows or 1)
            # without a deadline of its own, a message's later parts line up anew, behind others that came meanwhile
            since = arrived if first or urgency.firm else time.perf_counter()
            return Request(
                arrived=arrived,
                deadline=since + urgency.within,
                firm=urgency.firm,
                priority=urgency.priority,
                source=connection.id,
                slowed=connection.slowed,
                session=plan.name,
                rows=rows,
                later=later,
                alone=connection.bad_in_a_row > 0,  # after a bad one it is likely bad, too: it must spoil no batch
            )

        if urgency.rows is None:
            return self._calls.ask(request(1, 0), plan.observation, plan.arguments)
        return asyncio.ensure_future(self._calls.ask_rows(request, partial(row, plan.observation), urgency.rows))

    def release(self, asking: Asking) -> None:
        self._real_time.release(asking.plan)

    def wrong(self, asking: Asking, outcomes: Sequence[Outcome]) -> Outcome | None:
        """The first outcome without actions, its row in the text; None if all have some."""
        for number, outcome in enumerate(outcomes):
            if outcome.wrong in ("observation", "actions") and asking.rows is not None:
                text = f"row {number} of {asking.rows} (from 0): {outcome.text}"
                return Outcome(outcome.seconds, wrong=outcome.wrong, text=text)
            if outcome.wrong == "actions" and (previous := asking.plan.asked.previous) is not None:
                largest = float(abs(previous.left_over).max())
                text = f"{outcome.text}. This request's {PREFIX}previous has values up to {largest:.3g}, and most "
                text += "normalised actions are from -1 to 1: if they are far off, look there first"
                return Outcome(outcome.seconds, wrong=outcome.wrong, text=text)
            if outcome.wrong is not None:
                return outcome
        return None

    def answer(self, asking: Asking, outcomes: Sequence[Outcome]) -> dict[str, Any]:
        """The result to send, of outcomes that all have actions; with `server_timing`."""
        results = [outcome.result for outcome in outcomes if outcome.result is not None]
        runs = list({outcome.run: outcome for outcome in outcomes}.values())
        server_timing: dict[str, float] = {"infer_ms": sum(run.seconds for run in runs) * 1e3}
        if asking.rows is None:
            if outcomes[0].together > 1:
                server_timing["batch"] = outcomes[0].together
            return {**self._real_time.finish(asking.plan, results[0]), "server_timing": server_timing}
        timing = summed([run.result.get(TIMING, {}) for run in runs if run.result is not None])
        return {**stacked(results), TIMING: timing, "server_timing": server_timing}
