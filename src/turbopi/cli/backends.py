"""The list of backends, a part of `turbopi doctor`, and that command's old name."""

from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

from turbopi.cli.framework import JsonFlag, Output, command
from turbopi.cli.typed import as_typed
from turbopi.support.errors import BackendUnavailable, ConfigError

if TYPE_CHECKING:
    import torch

    from turbopi.backends import Precision
    from turbopi.checkpoint import Checkpoint

DeviceOption = Annotated[str, typer.Option("--device", metavar="DEVICE", help="auto, cpu, cuda or cuda:N.")]
PrecisionOption = Annotated[
    str | None,
    typer.Option(
        "--precision",
        metavar="bf16|f32|int8-weights|fp8|fp8-mlp|fp8-f16sums|int8|nvfp4",
        help="Say what auto takes in this one; else in bf16, or what the folder's weights are in.",
    ),
]


@command("backends", hidden=True, examples=("turbopi backends", "turbopi backends --device cpu --json"))
def backends(device: DeviceOption = "auto", precision: PrecisionOption = None, as_json: JsonFlag = False) -> None:
    """List the backends. A part of `turbopi doctor`, whose name this was."""
    output = Output(as_json)
    found = list_backends(device, precision or "bf16")
    show_backends(found, output)
    output.line("note: `turbopi doctor` has this list, too; `turbopi backends` goes with the next version", "yellow")
    output.document(found)


def resolve_gpu(device: str, purpose: str) -> "torch.device":
    """The GPU that `device` stands for. Raises BackendUnavailable where that is none; `purpose`: what needs it."""
    from turbopi import backends

    resolved = backends.resolve_device(device)
    if resolved.type != "cuda":
        found = "there is none here; `turbopi doctor` says why" if device == "auto" else f"--device {device} isn't one"
        raise BackendUnavailable(f"{purpose} an NVIDIA GPU, and {found}")
    return resolved


def list_backends(device: str, precision: str, checkpoint: "Checkpoint | None" = None) -> dict[str, Any]:
    """Whether each backend can run here, in which precisions, and why not, as JSON values. Raises ConfigError.

    checkpoint: for what runs its model; without one, a Pi0.5's.
    """
    from turbopi import backends as registry
    from turbopi.policy.kept_precision import check_backend

    resolved = registry.resolve_device(device)
    tier = registry.checked_precision(precision)
    chosen, why = registry.choose(resolved, tier, *(() if checkpoint is None else (checkpoint.config.model,)))
    why = as_typed(why)
    try:
        if checkpoint is None:
            registry.check(chosen, resolved, tier)
        else:
            check_backend(chosen, resolved, tier, checkpoint)
        runs = True
    except (BackendUnavailable, ConfigError) as error:
        why, runs = f"auto can't run in {precision} here: {as_typed(str(error))}", False
    listed = [
        {
            "name": spec.name,
            "available": (reason := _why_not(spec.name, resolved, tier, checkpoint)) is None,
            "reason": reason,
            "precisions": list(registry.precisions(spec.name, None if checkpoint is None else checkpoint.config.model)),
            "summary": spec.summary,
            "auto": spec.name == chosen,
        }
        for spec in registry.listed().values()
    ]
    return {
        "device": str(resolved),
        "precision": precision,
        "auto": chosen,
        "auto_reason": why,
        "auto_runs": runs,
        "backends": listed,
    }


def _why_not(name: str, device: "torch.device", tier: "Precision", checkpoint: "Checkpoint | None") -> str | None:
    from turbopi import backends
    from turbopi.checkpoint.quantized_folder import precision_kept

    kept = None if checkpoint is None else precision_kept(checkpoint)
    if kept is not None and name != "fused" and name in backends.BACKENDS:
        return f"the folder keeps its weights in {kept}, which backend 'fused' alone runs"
    if (reason := backends.availability(name, device)) is not None or checkpoint is None:
        return reason
    own = backends.precisions(name, checkpoint.config.model) or backends.precisions(name)
    return backends.refusal(name, device, tier if tier in own else own[0], checkpoint.config.model)


def show_backends(found: dict[str, Any], output: Output) -> None:
    """Print what `list_backends` found, in lines, so that a command can be copied whole."""
    output.line(f"backends on {found['device']}", "bold")
    width = max(len(entry["name"]) for entry in found["backends"])
    for entry in found["backends"]:
        mark = "[green]yes[/]" if entry["available"] else "[red]no[/] "
        precisions = ", ".join(entry["precisions"]) + ("  (auto)" if entry["auto"] else "")
        output.styled(f"{mark}   [bold]{entry['name']:<{width}}[/]  {precisions}")
        about = str(entry["summary"] if entry["available"] else entry["reason"])
        output.styled(f"      [dim]{escape(about)}[/]")
    why = found["auto_reason"]
    if found["auto_runs"]:
        output.line(f"auto takes {found['auto']} in {found['precision']}: {why.removeprefix('auto: ')}")
    else:
        output.line(why, "yellow")
