"""Pi0-FAST's reference against what openpi's and LeRobot's own code computed."""

import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from pi0_fast_golden import GOLDEN, RUNS, make_folder, make_hub, policy_of, runs
from smolvla_golden import relative

from turbopi import UnifiedPolicy
from turbopi.models.observation import Observation
from turbopi.models.pi0_fast.action_tokens import FastTokenizer, codes_of
from turbopi.models.pi0_fast.reference import Trace, compacted
from turbopi.support.errors import TokenizerError

ALL = [(name, run) for name, count in RUNS.items() for run in range(count)]
CLEANS = '{"clean_up_tokenization_spaces": true}'
SEEN = [(name, run) for name, run in ALL if name not in ("relative", "short_execution")]  # with intermediates


@pytest.fixture(scope="module")
def policies(tmp_path_factory: pytest.TempPathFactory) -> Any:
    root = tmp_path_factory.mktemp("fast")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HF_HUB_CACHE", str(make_hub(root / "hub")))
        yield cache(lambda name: policy_of(make_folder(name, root / name), backend="pytorch"))


def inputs_of(policy: UnifiedPolicy, name: str, run: int) -> Observation:
    return Observation.stack([policy.prepare(runs(name).observation(run))])


@pytest.mark.parametrize(("name", "run"), SEEN)
def test_the_answer_is_the_owners_id_for_id(policies: Any, name: str, run: int) -> None:
    policy, theirs, trace = policies(name), runs(name).expected(run), Trace()
    steps, observation = policy.metadata["max_decoding_steps"], inputs_of(policy, name, run)
    (ids,) = policy.backend.model.generate(observation, policy.backend.reader, steps, trace=trace)
    there = theirs["generated"].tolist()
    assert there[: len(ids)] == ids and set(there[len(ids) :]) <= {0, 1}  # openpi's model goes on to EOS
    positions = trace["decode_positions"][:, 0].tolist()
    assert positions == theirs["decode_positions"].tolist()[: len(ids)]
    first = theirs["first_logits"]
    assert relative(trace["logits"][: len(first), 0].numpy(), first) <= 1e-5  # seen: 2e-6
    rows, embeddings = ("embedding_rows", "embeddings") if name == "openpi" else ("prefix_rows", "prefix_embeddings")
    assert relative(trace["prefix_embs"][0, theirs[rows]].numpy(), theirs[embeddings]) <= 1e-6
    if name != "openpi":
        assert (trace["prefix_positions"][0].numpy() == theirs["prefix_positions"]).all()
        assert (trace["prefix_pad_mask"][0].numpy() == theirs["prefix_pad"]).all()
    # without what nothing sees, a step with buffers of another size
    model, reader = policy.backend.model, policy.backend.reader
    assert model.generate(compacted(observation), reader, min(len(ids) + 3, steps)) == [ids]


@pytest.mark.parametrize(("name", "run"), [one for one in ALL if one[0] in ("base", "broken", "relative")])
def test_codes_and_characters_are_the_owners(policies: Any, name: str, run: int) -> None:
    policy, theirs = policies(name), runs(name).expected(run)
    reader = policy.backend.reader
    codes = codes_of(theirs["generated"].tolist(), "lerobot", reader.pieces, prefix=reader.config.checks_prefix)
    assert codes == theirs["fast_ids"].tolist()
    if "fast_codepoints" in theirs:
        assert [ord(one) for one in reader.tokenizer.text(codes)] == theirs["fast_codepoints"].tolist()


def test_rows_of_a_batch_are_as_each_alone(policies: Any) -> None:
    policy = policies("base")
    model, reader = policy.backend.model, policy.backend.reader
    each = [policy.prepare(runs("base").observation(run)) for run in (0, 1)]
    alone = [model.generate(Observation.stack([one]), reader, 80)[0] for one in each]
    assert model.generate(Observation.stack(each), reader, 80) == alone
    assert len(alone[0]) != len(alone[1])


def test_a_step_never_waits_and_changes_no_buffers_place(policies: Any) -> None:
    """What a graph replays: the same tensors, whatever they hold."""
    policy = policies("base")
    model, reader = policy.backend.model, policy.backend.reader
    observation = inputs_of(policy, "base", 0)
    decoding = model.allocate(observation, 40, reader.ends)
    places = [tensor.data_ptr() for tensor in (*decoding.keys, *decoding.values, decoding.ids, decoding.logits)]
    for _ in range(2):  # what the first answer left changes nothing
        with torch.no_grad():
            model.begin(observation, decoding)
            for _ in range(39):
                model.step(decoding)
        (ids,) = decoding.rows(reader, 40)
        assert ids == model.generate(observation, reader, 40)[0]
        for left in (*decoding.keys, *decoding.values):
            left.fill_(7.0)
    assert places == [one.data_ptr() for one in (*decoding.keys, *decoding.values, decoding.ids, decoding.logits)]


def test_both_layouts_of_the_action_tokenizer_are_read() -> None:
    flat, folded = (FastTokenizer.from_folder(GOLDEN / "hub" / name) for name in ("fast", "fast-action-tokenizer"))
    assert flat == folded


def test_a_folder_that_is_no_action_tokenizer_is_named(tmp_path: Path) -> None:
    with pytest.raises(TokenizerError, match=r"needs processor_config\.json"):
        FastTokenizer.from_folder(tmp_path)
    (tmp_path / "processor_config.json").write_text('{"scale": 10, "min_token": -354}')
    (tmp_path / "tokenizer.json").write_text('{"model": {}}')
    with pytest.raises(TokenizerError, match="no vocabulary"):
        FastTokenizer.from_folder(tmp_path)
    content = {"model": {"vocab": {"!": 0}}, "added_tokens": [{"content": "ab", "id": 1}]}
    for decoder, beside, message in (("Metaspace", "{}", "expected 'ByteLevel'"), ("ByteLevel", CLEANS, "drops")):
        (tmp_path / "tokenizer.json").write_text(json.dumps(content | {"decoder": {"type": decoder}}))
        (tmp_path / "tokenizer_config.json").write_text(beside)
        with pytest.raises(TokenizerError, match=message):
            FastTokenizer.from_folder(tmp_path)
    (tmp_path / "tokenizer_config.json").unlink()
    assert FastTokenizer.from_folder(tmp_path).text([1, 0, 2]) == "ab!"


def test_stopping_at_the_mark_is_exact_for_openpi_behind_the_beginning_alone(policies: Any) -> None:
    reader = policies("openpi").backend.reader
    pieces = reader.pieces
    mark, eos = reader.ends
    assert not reader.over([mark]) and reader.over([mark, eos])
    assert reader.over([*pieces.encode("Action: "), 970, mark])
    assert not reader.over([mark, *pieces.encode("Action: "), 970][:1])
    assert np.array_equal([mark], pieces.encode("|"))
