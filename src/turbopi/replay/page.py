"""The report folder: replay.json, plots, and replay.html, one page that opens from disk beside them."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from turbopi.evaluate.pages import render
from turbopi.replay import plots
from turbopi.replay.compare import Compared, names_of
from turbopi.replay.document import Changed, Joint, PolicyDocument, ReplayDocument, Spread, State
from turbopi.support.files import write_whole
from turbopi.support.reading import plain_document
from turbopi.support.text import significant

DOCUMENT, PAGE = "replay.json", "replay.html"
MOST_INDICES = 10  # rows of the table by index


@dataclass(frozen=True)
class Material:
    """What the plots are drawn of. rows, observations: of the worst moments."""

    compared: Sequence[Compared]
    rows: Sequence[int]
    observations: Sequence[Mapping[str, Any]]
    action_names: Sequence[str] | None


def write_report(folder: Path, document: ReplayDocument, material: Material) -> Path:
    """Write all of it; returns the page."""
    folder.mkdir(parents=True, exist_ok=True)
    write_whole(folder / DOCUMENT, json.dumps(plain_document(document), indent=1, ensure_ascii=False) + "\n")
    first = material.compared[0]
    joints = names_of(first, material.action_names)
    plots.plot_by_index(folder / "by_index.png", document.policies, document.controls)
    plots.plot_joints(folder / "joints.png", document.policies)
    episode = plots.plot_episode(folder / "episode.png", material.compared, joints)
    names = [name for name, _ in joints]
    plots.plot_worst(
        folder / "worst.png", material.compared, material.rows, document.worst, material.observations, names
    )
    page = folder / PAGE
    write_whole(page, _page(document, episode))
    return page


def _page(document: ReplayDocument, episode: str) -> str:
    policies, first, data = document.policies, document.policies[0], document.dataset
    return render(
        "replay.html",
        title=f"replay: {Path(data.path).name}",
        dataset=data,
        policies=policies,
        verdict=document.verdict,
        random_weights=bool(first.policy.get("random_weights")),
        notes=document.notes,
        cards=_cards(document),
        joint_heads=joint_heads(document),
        joints=joint_rows(document),
        index_heads=["action of the chunk", *columns_by_index(document)],
        indices=index_rows(document),
        changed=[changed_row(one) for one in first.changed],
        states=[
            [one.name, span(one.recorded), span(one.trained), "outside" if one.outside else ""]
            for one in document.states
        ],
        against=None if document.against is None else against_text(document),
        episode=episode,
        keys=sorted(first.keys.items()),
        settings=[(policy.label, _settings(policy)) for policy in document.policies],
        seed=document.seed,
    )


def _settings(policy: PolicyDocument) -> list[tuple[str, str]]:
    return [("checkpoint", policy.checkpoint), *((key, str(value)) for key, value in policy.policy.items())]


def _cards(document: ReplayDocument) -> list[tuple[str, str, str]]:
    """What is read first: name, value, more."""
    cards = [
        (
            "error" if len(document.policies) == 1 else policy.label,
            significant(policy.relative.mean),
            _more(policy.relative),
        )
        for policy in document.policies
    ]
    return [*cards, *((control.name, significant(control.relative), "a control") for control in document.controls)]


def _more(relative: Spread) -> str:
    return f"95 %: {significant(relative.p95)}, most {significant(relative.max)}"


# --- tables, of the page and of the terminal --------------------------------------------------------------------------


def joint_heads(document: ReplayDocument) -> list[str]:
    second = ["mean of the 2nd"] if len(document.policies) > 1 else []
    return ["action", "unit", "mean", "95 %", "max", "relative", *second, "corr.", "recorded", "trained"]


def joint_rows(document: ReplayDocument) -> list[list[str]]:
    others = [policy.joints for policy in document.policies[1:]]
    return [
        _joint_row(joint, [policy[index] for policy in others])
        for index, joint in enumerate(document.policies[0].joints)
    ]


def _joint_row(joint: Joint, others: Sequence[Joint]) -> list[str]:
    return [
        joint.name,
        joint.unit,
        significant(joint.error.mean),
        significant(joint.error.p95),
        significant(joint.error.max),
        "never moved" if joint.relative is None else significant(joint.relative.mean),
        *(significant(other.error.mean) for other in others),
        "-" if joint.correlation is None else f"{joint.correlation:.2f}",
        span(joint.recorded),
        span(joint.trained),
    ]


def _state_row(one: State) -> list[str]:
    return [one.name, span(one.recorded), span(one.trained), "outside" if one.outside else ""]


def span(values: tuple[float, float] | None) -> str:
    return "-" if values is None else f"{values[0]:.3g} … {values[1]:.3g}"


def columns_by_index(document: ReplayDocument) -> list[str]:
    labels = ["policy"] if len(document.policies) == 1 else [policy.label for policy in document.policies]
    return [*labels, "its 95 %", *(control.name for control in document.controls)]


def index_rows(document: ReplayDocument) -> list[list[str]]:
    """Some indices of the chunk, the first and the last among them."""
    policies = document.policies
    last = len(policies[0].by_index) - 1
    chosen = sorted({0, last, *(round(last * part / (MOST_INDICES - 1)) for part in range(MOST_INDICES))})
    return [
        [
            str(index),
            *(_at([one.mean for one in policy.by_index], index) for policy in policies),
            _at([one.p95 for one in policies[0].by_index], index),
            *(_at(control.by_index, index) for control in document.controls),
        ]
        for index in chosen
    ]


def _at(values: Sequence[float], index: int) -> str:
    return significant(values[index]) if index < len(values) else "-"


def changed_row(one: Changed) -> list[str]:
    return [one.name, significant(one.relative), significant(one.as_recorded), f"{one.nearer} of {one.moments}"]


def against_text(document: ReplayDocument) -> str:
    one, (first, second) = document.against, document.policies
    assert one is not None
    interval = (
        "" if one.interval is None else f" [{one.interval[0]:+.3g}, {one.interval[1]:+.3g}] (95 %, episodes resampled)"
    )
    return (
        f"{second.label} beside {first.label}, the same noise: the error differs by {one.difference:+.3g}{interval}; "
        f"it is nearer to what was recorded at {one.nearer} of {one.moments} moments. The two are "
        f"{significant(one.chunks.mean)} from each other (95 %: {significant(one.chunks.p95)})."
    )
