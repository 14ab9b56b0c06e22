"""LeRobot's two processor pipelines: which steps they have, in which order, and what each asks for.

LeRobot runs whatever steps the files list, in their order. Turbo-Pi runs an edge of its own that computes what the
steps below compute in the order below. Everything else is refused by its name: a step, an order, a value or a key that
asks for something that isn't done never passes unnoticed.

Preprocessor of Pi0.5. The state's step and the tokenizer must be there; without a normalizer the state stays as it is:

    rename_observations_processor                   names of observations to names of the policy
    relative_actions_processor                      keeps the raw state (0.5.1: delta_actions_processor)
    normalizer_processor                            scales the state
    pi05_prepare_state_tokenizer_processor_step     writes the state into the prompt
    tokenizer_processor                             prompt to tokens

Preprocessor of Pi0, whose prompt has no state; what is about the prompt may stand before or behind the rest:

    rename_observations_processor, relative_actions_processor, normalizer_processor
    pi0_new_line_processor                          puts a newline behind the prompt, unless there is one
    tokenizer_processor                             prompt to tokens, as it is

Preprocessor of SmolVLA: as Pi0's, with smolvla_new_line_processor and any tokenizer, which the Hub's cache may hold.

Preprocessor of Pi0-FAST: as Pi0.5's, with pi0_fast_prepare_state_tokenizer_processor_step, and

    action_tokenizer_processor                      for training; names the action tokenizer that the folder may have

Preprocessor of pi052 (LeRobot's open PR 4184): as Pi0.5's, or in place of its last two, whose prompts inference makes
by itself either way,

    render_messages_processor, pi052_text_tokenizer, action_tokenizer_processor

Postprocessor; both may be missing:

    unnormalizer_processor                          scales actions back
    absolute_actions_processor                      adds the state that was kept

These change no number of a single observation, and may stand anywhere and often: to_batch_processor and its three
parts; device_processor without a float_dtype, or with float32. So may the two new-line steps before the state's, which
strips the prompt.

Sources: LeRobot 0.4.0 to 0.6.1, `processor/`, `policies/pi0/processor_pi0.py` and `policies/pi05/processor_pi05.py`.
"""

import os
import re
from dataclasses import dataclass
from pathlib import Path

from turbopi.config import LIMITS, Kind
from turbopi.models import FAMILIES
from turbopi.support.errors import CheckpointError
from turbopi.support.hub_cache import hub_folder
from turbopi.support.reading import Fields, file_inside, read_json, shown

PREPROCESSOR, POSTPROCESSOR = "policy_preprocessor.json", "policy_postprocessor.json"
STATE, ACTION, OBSERVATION = "observation.state", "action", "observation."

RENAME, RELATIVE, NORMALIZER = "rename_observations_processor", "relative_actions_processor", "normalizer_processor"
STATE_STEP, TOKENIZER = "pi05_prepare_state_tokenizer_processor_step", "tokenizer_processor"
ACTION_TOKENIZER = "action_tokenizer_processor"
TEXT_TOKENIZER, MESSAGES = "pi052_text_tokenizer", "render_messages_processor"
NEW_LINE = "pi0_new_line_processor"
UNNORMALIZER, ABSOLUTE, DEVICE = "unnormalizer_processor", "absolute_actions_processor", "device_processor"
PALIGEMMA = "google/paligemma-3b-pt-224"

_OTHER_NAMES = {"delta_actions_processor": RELATIVE}
_NEW_LINES = (NEW_LINE, "smolvla_new_line_processor")  # the same step twice
_BATCH = ("", "_action", "_observation", "_complementary_data")
_SCALING = ("eps", "features", "norm_map", "normalize_observation_keys")
# name: the keys that its config may have
_HARMLESS: dict[str, tuple[str, ...]] = {DEVICE: ("device", "float_dtype")} | {
    f"to_batch_processor{part}": () for part in _BATCH
}
_STEPS: dict[str, dict[str, tuple[str, ...]]] = {
    PREPROCESSOR: {
        RENAME: ("rename_map",),
        RELATIVE: ("enabled", "exclude_joints", "action_names"),
        NORMALIZER: _SCALING,
        STATE_STEP: ("max_state_dim", "task_key", "include_state_in_prompt"),
        TOKENIZER: ("tokenizer_name", "max_length", "task_key", "padding", "padding_side", "truncation"),
        **_HARMLESS,
        **dict.fromkeys(_NEW_LINES, ()),
        ACTION_TOKENIZER: (
            *("action_tokenizer_name", "trust_remote_code", "max_action_tokens", "fast_skip_tokens"),
            *("paligemma_tokenizer_name", "allow_truncation"),
        ),
        MESSAGES: ("recipe", "dataset_ctx"),
        TEXT_TOKENIZER: (
            *("tokenizer_name", "max_length", "padding", "padding_side", "plan_dropout_prob", "memory_dropout_prob"),
            *("subtask_dropout_prob", "interjection_dropout_prob", "dropout_seed"),
        ),
    },
    POSTPROCESSOR: {UNNORMALIZER: _SCALING, ABSOLUTE: ("enabled",), **_HARMLESS},
}
_OFTEN = {*_HARMLESS, *_NEW_LINES}
_ORDER = (RENAME, RELATIVE, NORMALIZER, *_NEW_LINES, STATE_STEP, TOKENIZER, UNNORMALIZER, ABSOLUTE)
_PROMPT = (*_NEW_LINES, STATE_STEP, TOKENIZER)
_BEFORE = {(first, then) for i, first in enumerate(_ORDER) for then in _ORDER[i + 1 :] if then not in _NEW_LINES}
_SAME_NUMBERS = (None, "float32", "float")  # a device step's float_dtype: everything is float32 already


@dataclass(frozen=True)
class Step:
    """One step of a pipeline, checked."""

    name: str
    config: Fields
    file: Path  # that lists it
    state_file: str | None  # of its tensors, beside `file`
    artifacts: Fields  # what LeRobot saved beside `file` for values of config: after 0.6.1 alone


class Pipelines:
    """What the two files of a folder ask for. Raises CheckpointError for all that Turbo-Pi doesn't compute.

    kind            of the policy that they are for
    steps           the steps that compute something, by name
    rename_map      observations' names -> the policy's
    max_tokens      of a prompt
    tokenizer       the folder that the tokenizer's name points to, in the checkpoint, the Hub's cache or elsewhere on
                    this machine. None: it is PaliGemma's, by its name
    notes           what isn't sure about them
    state_tokens    past states are tokens of their own (MEM): prompts have none, unless the file says so
    text            it is a pi052's
    state_in_prompt whether prompts have the state: always Pi0.5's of LeRobot to 0.6.1, never Pi0's
    prompt_width    numbers of state that LeRobot 0.4 wrote into the prompt at least; newer ones don't read it.
                    0 for Pi0, which writes none
    """

    def __init__(self, folder: Path, kind: Kind = "pi05", *, state_tokens: bool = False, text: bool = False) -> None:
        self.notes: list[str] = []
        self._paligemma = FAMILIES[kind].paligemma
        self.steps = {step.name: step for name in _STEPS for step in _read(folder / name, kind, text)}
        self.rename_map = self._rename_map()
        self._check_task_keys()
        self.max_tokens = self._tokenizer()
        self.tokenizer = self._named_tokenizer(folder)
        self.prompt_width, self.state_in_prompt = 0, text
        if FAMILIES[kind].state_in_prompt and not text:
            state_step = self.steps[STATE_STEP]
            self.prompt_width = state_step.config.integer("max_state_dim", 1, LIMITS["action_dim"], 32)
            self.state_in_prompt = state_step.config.flag("include_state_in_prompt", not state_tokens)
            if state_tokens and "include_state_in_prompt" not in state_step.config.values:
                self.notes.append(
                    "prompts have no state, as in training with proprioceptive memory. LeRobot doesn't save that, and "
                    'its own policy writes the state into them: {"discrete_state_input": true} in a turbopi.json does '
                    "so, too"
                )
            elif not self.state_in_prompt:
                self.notes.append(
                    f"{PREPROCESSOR} says include_state_in_prompt = false: prompts have no state. If the policy was "
                    'trained with it, put {"discrete_state_input": true} into a turbopi.json'
                )

    def relative_mask(self, action_dim: int) -> list[bool] | None:
        """Which of the actions are relative to the state when they leave the model, and absolute in the answer.

        None: the postprocessor adds nothing. A name is left out if an excluded joint's is a part of it, in any case;
        without names or exclusions nothing is.
        """
        absolute, relative = self.steps.get(ABSOLUTE), self.steps.get(RELATIVE)
        if absolute is None or not absolute.config.flag("enabled", False):
            return None
        if relative is None:
            raise CheckpointError(
                f"{absolute.file}: {ABSOLUTE} is enabled, but {PREPROCESSOR} has no {RELATIVE} whose state it could "
                "add; LeRobot can't run it either"
            )
        excluded = [str(joint).lower() for joint in _list_or_null(relative, "exclude_joints") if joint]
        names = [str(name).lower() for name in _list_or_null(relative, "action_names")][:action_dim]
        mask = [not any(joint in name for joint in excluded) for name in names]
        return mask + [True] * (action_dim - len(mask))

    @property
    def leaves_actions_relative(self) -> bool:
        """Whether the model was trained on relative actions, and nothing makes them absolute."""
        relative, absolute = (
            name in self.steps and self.steps[name].config.flag("enabled", False) for name in (RELATIVE, ABSOLUTE)
        )
        return relative and not absolute

    def _rename_map(self) -> dict[str, str]:
        if RENAME not in self.steps:
            return {}
        step = self.steps[RENAME]
        renames = step.config.object("rename_map", {}).values
        for old, new in renames.items():
            if not isinstance(new, str):
                raise CheckpointError(f"{step.file}: rename_map is {shown(renames)}; expected a new name for each key")
            if not old.startswith(OBSERVATION):
                raise CheckpointError(
                    f"{step.file}: rename_map has observations call {new} {old!r}, which LeRobot never reads: its "
                    f"keys begin with {OBSERVATION!r}"
                )
        if renames.get(STATE, STATE) != STATE and STATE not in renames.values():
            raise CheckpointError(
                f"{step.file}: rename_map makes {STATE} {renames[STATE]!r}, so there is no state; LeRobot can't run "
                "it either"
            )
        return dict(renames)

    def _check_task_keys(self) -> None:
        for step in (self.steps[name] for name in (STATE_STEP, TOKENIZER) if name in self.steps):
            if step.config.text("task_key", "task") != "task":
                step.config.refuse("task_key", "task, where Turbo-Pi looks for the prompt")

    def _tokenizer(self) -> int:
        step = self.steps[TOKENIZER]
        if not step.config.flag("truncation", True):
            raise CheckpointError(
                f"{step.file}: truncation is false, so LeRobot's prompts may be longer than max_length; Turbo-Pi cuts "
                "them. Set it to true if prompts are short enough"
            )
        # masked tokens change nothing, wherever they stand
        step.config.choice("padding", ("max_length", "longest", "do_not_pad"), "max_length")
        step.config.choice("padding_side", ("right", "left"), "right")
        # LeRobot's own defaults
        return step.config.integer(
            "max_length", 1, LIMITS["max_prompt_tokens"], 512 if MESSAGES not in self.steps else 200
        )

    def _named_tokenizer(self, folder: Path) -> Path | None:
        """What the tokenizer's name points to, not what it is called: after 0.6.1 LeRobot saves the tokenizer, too."""
        step = self.steps[TOKENIZER]
        if "tokenizer_name" in step.artifacts.values:
            named = file_inside(folder, step.artifacts.values["tokenizer_name"], step.file)
            if not named.is_dir():
                raise CheckpointError(
                    f"{step.file} names the tokenizer {named.relative_to(folder)} beside it, which isn't there; is the "
                    "download complete?"
                )
            return named
        name = step.config.text("tokenizer_name", PALIGEMMA)
        inside = folder / name  # an absolute name stays as it is
        if ".." not in Path(name).parts and os.path.isdir(inside):  # a name is any text: Path.is_dir may raise
            return inside
        if not self._paligemma:
            return hub_folder(name) or inside  # where it would be: a message names it
        if "paligemma" not in name.lower():
            raise CheckpointError(
                f"{step.file} tokenises with {name}; expected {PALIGEMMA}, or the name of a folder beside it that has "
                "the tokenizer"
            )
        if not re.fullmatch(r"(google/)?paligemma[\w.-]*", name):
            self.notes.append(f"{step.file.name} tokenises with {name}, which isn't here: PaliGemma's is taken for it")
        return None


def _read(file: Path, kind: Kind, text: bool) -> list[Step]:
    """The steps of one pipeline that compute something, each once and in the one order that Turbo-Pi has."""
    entries = read_json(file, hint="; is the download complete?").get("steps")
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise CheckpointError(f"{file} has no list of steps; is it a LeRobot processor?")
    steps = [_step(entry, file, kind, text) for entry in entries]
    names = [step.name for step in steps]
    for i, name in enumerate(names):
        if name in names[:i] and name not in _OFTEN:
            raise CheckpointError(f"{file} has the step {name} twice; Turbo-Pi does it once")
        late = next((earlier for earlier in names[:i] if _must_precede(name, earlier, kind)), None)
        if late is not None:
            order = ", ".join(step for step in _ORDER if step in _known(file, kind, text) and step not in _NEW_LINES)
            raise CheckpointError(f"{file} has {late} before {name}, which computes something else than {order}")
    needed = (STATE_STEP if FAMILIES[kind].state_in_prompt else NEW_LINE, TOKENIZER)[text:]
    for name in needed if file.name == PREPROCESSOR else ():
        if name not in names and not (name == NEW_LINE and set(names) & set(_NEW_LINES)):
            theirs = FAMILIES[kind].state_step if name == STATE_STEP else name
            raise CheckpointError(f"{file} has no step {theirs}, which every policy of type {kind} is trained with")
    return [step for step in steps if step.name not in _OFTEN]


def _must_precede(first: str, then: str, kind: Kind) -> bool:
    """Whether another order would compute something else: of Pi0, nothing in a prompt comes from the state."""
    apart = not FAMILIES[kind].state_in_prompt and (first in _PROMPT) != (then in _PROMPT)
    return (first, then) in _BEFORE and not apart


def _known(file: Path, kind: Kind, text: bool) -> dict[str, tuple[str, ...]]:
    family, own = FAMILIES[kind], (STATE_STEP, ACTION_TOKENIZER, MESSAGES, TEXT_TOKENIZER)
    steps = {name: keys for name, keys in _STEPS[file.name].items() if name not in own}
    if file.name == PREPROCESSOR and text:
        steps |= {name: _STEPS[file.name][name] for name in own[1:]}
    if file.name == PREPROCESSOR and family.state_step is not None:
        steps[family.state_step] = _STEPS[file.name][STATE_STEP]
    if file.name == PREPROCESSOR and family.reader is not None:
        steps[ACTION_TOKENIZER] = _STEPS[file.name][ACTION_TOKENIZER]
    return steps


def _step(entry: dict[str, object], file: Path, kind: Kind, text: bool) -> Step:
    known = _known(file, kind, text)
    given = entry.get("registry_name", entry.get("class"))
    name = _OTHER_NAMES.get(given, given) if isinstance(given, str) else None
    if name not in known:
        raise CheckpointError(
            f"{file} has a step {str(given)[:200]!r} that Turbo-Pi doesn't know; known are {', '.join(known)}"
        )
    config = Fields(Fields(entry, file).object("config", {}).values, file)
    allowed = known[name]
    unknown = [key for key in config.values if key not in allowed]
    if unknown:
        raise CheckpointError(
            f"{file}: {name} has {unknown[0]} = {shown(config.values[unknown[0]])}, which Turbo-Pi doesn't know; it "
            f"knows {', '.join(allowed) or 'no key of this step'}"
        )
    if config.values.get("float_dtype") not in _SAME_NUMBERS:
        config.refuse("float_dtype", "null or float32: Turbo-Pi rounds neither observations nor actions to others")
    fields = Fields(entry, file)
    state_file = None if "state_file" not in entry else fields.text("state_file")
    if name == FAMILIES[kind].state_step:
        name = STATE_STEP  # whichever family's: what it computes is `Family.prompt`'s
    if name == TEXT_TOKENIZER:
        name = TOKENIZER
    return Step(name, config, file, state_file, Fields(fields.object("artifacts", {}).values, file))


def _list_or_null(step: Step, key: str) -> list[object]:
    return [] if step.config.values.get(key) is None else step.config.list(key)
