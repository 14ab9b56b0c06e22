"""Make the small policy. Run from the repository, in an environment with turbopi-lab and turbopi[libero]:

    export MUJOCO_GL=egl
    alias small_policy='python -m turbopi_lab.small_policy'
    small_policy measure --initial-states 0-49             how good the expert is
    small_policy stats --out work/norm_stats.json          statistics of demonstrations, without images
    small_policy train --out work/run --stats work/norm_stats.json --seconds 420 --workers 32
    small_policy play --help                               episodes from machines without a GPU, for `train`
    small_policy judged --help                             what evaluations came to, in one file
    small_policy card --help                               the model card, from that file and the curves
    small_policy chase --out work/chase                    the policy of the dynamic task, see chase.py
    small_policy post --out work/two_ways --ways 2         a policy of two modes for studies, see post.py
    small_policy distill --start work/two_ways/checkpoint --out work/student   one step, see distill.py
    small_policy throughput                                samples a second, before a GPU is rented for long

`train` needs a GPU with 60 GB (fewer with a smaller --capacity) and 2 GB of memory for each worker. It leaves

    checkpoint/      openpi's PyTorch layout: turbopi eval libero work/run/checkpoint --initial-states 30-49
    curves.csv       losses, speed, frames, and the learner's success on validation states, by time
    episodes.jsonl   every episode that was played: scene, prompt, initial state, seed, success
    state.pt         to go on from, with --resume

For real-time execution the policy learns with simulated delays (trained RTC, see forward.py): --max-delay 6, with
chunks of episodes.py's HORIZON. Retraining the shipped policy, starting from its weights, and judging it:

    small_policy play --out work/tapes --seconds 3600 --seed 1 \\
        --learner src/turbopi/data/small_policy                              on CPUs, several at once
    small_policy train --out work/run --stats src/turbopi/data/small_policy/assets/turbopi/libero_spatial/\
norm_stats.json --start src/turbopi/data/small_policy --tapes work/tapes --seconds 560 --workers 15 --max-delay 6 \\
        --learning-rate 0.0007 --trial 0.06
    turbopi eval libero work/run/checkpoint --initial-states 30-49 --backend pytorch --precision f32 --workers 16 \\
        --videos none --out work/ordinary                                   delay 0: the bar is 93 %
    turbopi eval libero work/run/checkpoint --initial-states 30-49 --backend fused --workers 16 --videos none \\
        --execution async,sync,ensemble,rtc,rtc_identity,rtc_trained --delay-steps 0,1,2,4 --execution-horizon 5 \\
        --out work/delays                                                   200 paired episodes a cell
    small_policy train … --seconds 1100 --resume                  if it isn't good enough yet

The policy of the dynamic task (`small_policy chase`) takes minutes on a GPU, and a quarter of an hour on a CPU core
of its own:

    small_policy chase --out work/chase --seconds 300 --device cuda --batch 1024 --frames 300000 --workers 5
    turbopi eval chase work/chase/checkpoint --trials 200 --videos none --camera-px 48 --image-px 48 \\
        --execution async,sync,ensemble,rtc,rtc_identity,rtc_trained --delay-steps 0,2,4 --out work/chase_delays

A SmolVLA for the same task, in LeRobot's layout: chase_smolvla.py. It needs turbopi[smolvla].

    small_policy chase --model smolvla --out work/smolvla --seconds 3000 --frames 400000 --batch 64 --repeats 2

The data are in expert.py, scenes.py and collect.py, the learning in forward.py and train.py.
"""

import argparse
import json
import time
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m turbopi_lab.small_policy",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = parser.add_subparsers(dest="command", required=True)
    measure = commands.add_parser("measure", help="let the expert play, and count")
    measure.add_argument("--tasks", default="0-9")
    measure.add_argument("--initial-states", default="0-9")
    stats = commands.add_parser("stats", help="play demonstrations and write norm_stats.json")
    stats.add_argument("--out", type=Path, required=True)
    stats.add_argument("--tasks", default="0-9")
    stats.add_argument("--episodes", type=int, default=6, help="of each task")
    stats.add_argument("--raw", type=Path, help="also keep states and actions, as .npz; several runs' can be merged")
    stats.add_argument("--merge", type=Path, nargs="*", help="play nothing; take these .npz")
    judged = commands.add_parser("judged", help="what evaluations of one policy came to, paired with the first")
    judged.add_argument(
        "runs", nargs="+", metavar="NAME=FOLDER", help="folders of `turbopi eval`, such as float32=work/f32"
    )
    judged.add_argument("--out", type=Path, required=True)
    card = commands.add_parser("card", help="write the model card from results and curves")
    card.add_argument("--results", type=Path, required=True, help="what `judged` wrote")
    card.add_argument("--curves", type=Path, required=True, help="the training's curves.csv")
    card.add_argument("--out", type=Path, required=True)
    _add_chase(commands.add_parser("chase", help="the policy of the dynamic task: demonstrations, training, export"))
    _add_post(commands.add_parser("post", help="one of two policies that differ in their demonstrations, see post.py"))
    _add_distill(commands.add_parser("distill", help="a student that takes one denoising step, see distill.py"))
    speed = commands.add_parser("throughput", help="time training steps on random data")
    playing = commands.add_parser("play", help="play episodes and keep them without images, for train --tapes")
    playing.add_argument("--out", type=Path, required=True, help="a folder; several runs may share it")
    playing.add_argument("--seconds", type=float, required=True)
    playing.add_argument("--seed", type=int, required=True, help="another one for each run")
    playing.add_argument("--learner", type=Path, help="a checkpoint that drives in half of the episodes (DAgger)")
    playing.add_argument("--max-delay", type=int, default=6, help="as in train")
    _add_settings(commands.add_parser("train", help="collect and train, by the clock"))
    _add_settings(speed, required=False)
    arguments = parser.parse_args()
    run = {"measure": _measure, "stats": _stats, "train": _train, "throughput": _throughput, "card": _card}
    run["judged"] = _judged
    run |= {"chase": _chase, "play": _play, "post": _post, "distill": _distill}
    run[arguments.command](arguments)


def _add_settings(parser: argparse.ArgumentParser, required: bool = True) -> None:
    """One option for each field of train.Settings."""
    from turbopi_lab.small_policy.train import Settings

    for item in fields(Settings):
        name = "--" + item.name.replace("_", "-")
        needed = required and item.name in ("out", "stats")
        if item.type is bool:
            parser.add_argument(name, action=argparse.BooleanOptionalAction, default=item.default)
        else:
            default = None if item.name in ("out", "stats") else item.default
            kind = Path if item.name in ("out", "stats", "start", "tapes") else item.type
            parser.add_argument(name, type=kind, default=default, required=needed)


def _add_chase(parser: argparse.ArgumentParser) -> None:
    from turbopi_lab.small_policy.chase import Settings

    for item in fields(Settings):
        kind = Path if item.name in ("out", "resume") else item.type
        default = None if item.name == "out" else item.default
        parser.add_argument("--" + item.name.replace("_", "-"), type=kind, default=default, required=item.name == "out")


def _chase(arguments: argparse.Namespace) -> None:
    from turbopi_lab.small_policy.chase import Settings
    from turbopi_lab.small_policy.chase_training import train

    train(Settings(**{item.name: getattr(arguments, item.name) for item in fields(Settings)}))


def _add_post(parser: argparse.ArgumentParser) -> None:
    from turbopi_lab.small_policy.post import Settings

    for item in fields(Settings):
        kind = Path if item.name == "out" else item.type
        default = None if item.name == "out" else item.default
        parser.add_argument("--" + item.name.replace("_", "-"), type=kind, default=default, required=item.name == "out")


def _post(arguments: argparse.Namespace) -> None:
    from turbopi_lab.small_policy.post import Settings, train

    train(Settings(**{item.name: getattr(arguments, item.name) for item in fields(Settings)}))


def _add_distill(parser: argparse.ArgumentParser) -> None:
    from turbopi_lab.small_policy.distill import Settings

    for item in fields(Settings):
        needed = item.name in ("start", "out")
        kind = Path if needed else str if item.name == "recipe" else item.type
        default = None if needed else item.default
        parser.add_argument("--" + item.name.replace("_", "-"), type=kind, default=default, required=needed)


def _distill(arguments: argparse.Namespace) -> None:
    from turbopi_lab.small_policy.distill import Settings, train

    train(Settings(**{item.name: getattr(arguments, item.name) for item in fields(Settings)}))


def _settings(arguments: argparse.Namespace) -> Any:
    from turbopi_lab.small_policy.train import Settings

    return Settings(**{item.name: getattr(arguments, item.name) for item in fields(Settings)})


def _judged(arguments: argparse.Namespace) -> None:
    from turbopi_lab.small_policy.judged import write_judged

    runs = [run.partition("=") for run in arguments.runs]
    write_judged({name: Path(folder) for name, _, folder in runs}, arguments.out)


def _card(arguments: argparse.Namespace) -> None:
    from turbopi_lab.small_policy.card import write_card

    write_card(arguments.results, arguments.curves, arguments.out)


def _play(arguments: argparse.Namespace) -> None:
    from turbopi_lab.small_policy.play import learner_of, play

    learner = None if arguments.learner is None else learner_of(arguments.learner)
    play(arguments.out, arguments.seconds, arguments.seed, learner, arguments.max_delay)


def _train(arguments: argparse.Namespace) -> None:
    from turbopi_lab.small_policy.train import train

    train(_settings(arguments))


def _throughput(arguments: argparse.Namespace) -> None:
    import torch

    from turbopi_lab.small_policy.train import Trainer, toy_memory

    trainer = Trainer(_settings(arguments))
    memory = toy_memory(2 * arguments.batch, trainer.device)
    for number in range(60):
        if number in (1, 20):
            if trainer.device.type == "cuda":
                torch.cuda.synchronize()
            start = time.perf_counter()
        losses = trainer.step(memory.batch(memory.draw(arguments.batch)), 0.0)
        if number in (0, 1, 19, 59):
            values = {name: round(float(value), 4) for name, value in losses.items()}
            print(number, values, f"{time.perf_counter() - start:.2f} s" if number else "", flush=True)
    print(f"{40 * arguments.batch / (time.perf_counter() - start):.0f} samples/s")
    if trainer.device.type == "cuda":
        print(f"{torch.cuda.max_memory_allocated() / 2**30:.1f} GiB")


def _measure(arguments: argparse.Namespace) -> None:
    from turbopi.evaluate.plan import parse_numbers
    from turbopi_lab.small_policy.expert import Expert
    from turbopi_lab.small_policy.scenes import BOWL, MAX_STEPS, PracticeScene

    total: list[int | None] = []
    for task in parse_numbers("--tasks", arguments.tasks):
        scene, steps = PracticeScene(task), []
        for state in parse_numbers("--initial-states", arguments.initial_states):
            scene.reset(state)
            expert = Expert(scene.domain, BOWL)
            solved = (number for number in range(1, MAX_STEPS + 1) if scene.step(expert.act(), look=False))
            steps.append(next(solved, None))
        scene.close()
        total += steps
        print(json.dumps({"task": task, **_summary(steps)}), flush=True)
    print(json.dumps({"task": "all", **_summary(total)}))


def _summary(steps: "list[int | None]") -> dict[str, Any]:
    from turbopi_lab.small_policy.scenes import MAX_STEPS

    solved = [number for number in steps if number is not None]
    within = sum(number <= 190 for number in solved)
    mean = round(float(np.mean(solved)), 1) if solved else None
    return {"episodes": len(steps), f"solved in {MAX_STEPS}": len(solved), "in 190": within, "steps": mean}


def _stats(arguments: argparse.Namespace) -> None:
    from turbopi_lab.small_policy.statistics import merged, play, write

    if arguments.merge is None:
        states, actions = play(arguments.tasks, arguments.episodes)
    else:
        states, actions = merged(arguments.merge)
    if arguments.raw:
        np.savez_compressed(arguments.raw, states=states, actions=actions)
    write(arguments.out, states, actions)


if __name__ == "__main__":
    main()
