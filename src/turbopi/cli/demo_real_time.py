"""`turbopi demo --real-time`."""

import json
from pathlib import Path
from typing import TYPE_CHECKING

from rich.progress import Progress

from turbopi.cli.files import check_report
from turbopi.cli.framework import Output, new_console, plain
from turbopi.cli.options import PolicyOptions
from turbopi.support.files import write_whole
from turbopi.support.reading import plain_document

if TYPE_CHECKING:
    from turbopi.evaluate.statistics import Paired

EPISODES = 100


def show_real_time(
    options: PolicyOptions, checkpoint: str | None, episodes: int | None, seed: int, report: Path, output: Output
) -> None:
    """Play, tell and plot. The numbers are counted here, and the sentences follow from them."""
    check_report(report / "real_time.json", "ways", "a report of `turbopi demo --real-time`")
    if checkpoint is None and options.random_weights is None:
        from turbopi.policy.shipped import CHASE_POLICY

        checkpoint = str(CHASE_POLICY)
    from turbopi.evaluate.real_time_demo import (
        DELAY,
        HORIZON,
        SIMULATOR,
        WAYS,
        paired,
        play,
        plot_commands,
        plot_successes,
    )
    from turbopi.evaluate.sources import LocalPolicy

    opened = options.open(checkpoint)
    options.tell_if_random(opened, output)
    policy = options.make_policy(opened, output)
    policy.warmup()
    source, count = LocalPolicy(policy), EPISODES if episodes is None else episodes
    px = policy.config.model.image_size
    cells = [(WAYS[0], 0), *((way, DELAY) for way in WAYS)]
    played = []
    with Progress(console=new_console(stderr=True), disable=not output.shows_progress) as bar:
        task = bar.add_task("episodes", total=count * len(cells))
        for way, delay in cells:
            played.append(play(source, way, delay, count, px=px, seed=seed, tick=lambda: bar.advance(task)))
    ideal, naive, joined = played
    output.line(f"{count} episodes of {SIMULATOR}, the same ones in every row; {HORIZON} actions a chunk:")
    for one in played:
        jump = "" if one.seam_jump is None else f"; the command jumps by {one.seam_jump:.2f} at a seam"
        output.line(
            f"  {one.way}, delay {one.delay}: {one.rate.successes} of {one.rate.trials} {one.rate}{jump}", "bold"
        )
    order = sorted(played, key=lambda one: -one.rate.successes)
    named = ", ".join(f"{one.way} with delay {one.delay} ({one.rate.successes})" for one in order)
    output.line(f"By successes: {named}.")
    change, gain = paired(ideal, naive), paired(naive, joined)
    output.line(
        f"A delay of {DELAY} control steps changes naive asynchronous execution by {_points(change)}. "
        + _why(change, -1, "Each chunk was computed as if its own first actions had been carried out meanwhile", count)
    )
    output.line(
        f"Joining chunks ({WAYS[1]}) changes that by {_points(gain)}. "
        + _why(gain, 1, "The model is told which actions are carried out meanwhile, and continues them", count)
    )
    report.mkdir(parents=True, exist_ok=True)
    plots = [plot_successes(report / "real_time.png", played), plot_commands(report / "commands.png", played)]
    reported = {
        "episodes": count,
        "execution_horizon": HORIZON,
        "ways": [
            {
                "execution": one.way,
                "delay": one.delay,
                "success": plain_document(one.rate.document),
                "seam_jump": one.seam_jump,
                "outcomes": "".join(ending.status[0] for ending in one.endings),
            }
            for one in played
        ],
        "delay_costs": plain_document(change.document),
        "joining_gains": plain_document(gain.document),
        "policy": plain(policy.metadata),
    }
    write_whole(report / "real_time.json", json.dumps(reported, indent=1) + "\n")
    output.line(f"plots: {', '.join(map(str, plots))}")
    output.document({name: value for name, value in reported.items() if name != "policy"} | {"report": str(report)})


def _why(paired: "Paired", sign: int, reason: str, count: int) -> str:
    """The reason, if the difference has this sign beyond chance."""
    low, high = sorted(sign * end for end in paired.interval)
    if low > 0:
        return f"{reason}."
    if high < 0:
        return "Here the other way was expected."
    return f"{count} episodes don't tell whether there is a difference: --episodes 100 or more."


def _points(paired: "Paired") -> str:
    low, high = paired.interval
    return f"{100 * (paired.difference or 0):+.0f} points [95 %: {100 * low:+.0f} to {100 * high:+.0f}]"
