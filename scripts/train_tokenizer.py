#!/usr/bin/env python3
"""Train the project's own small SentencePiece model, `src/turbopi/data/small_policy/tokenizer.model`.

It stands in for PaliGemma's tokenizer where no trained weights are at stake: tests, the demo, random weights. It
behaves like Gemma's: BPE with byte fallback, pad 0, eos 1, bos 2, unk 3, text taken as it is (no normalisation, no
blank put in front), every digit a piece of its own, "\\n" a piece. Its corpus is made here, so that anyone can make the
file again; the result is the same for the same SentencePiece version.

    python scripts/train_tokenizer.py [OUT]
"""

import io
import itertools
import random
import sys
from collections.abc import Iterator
from pathlib import Path

import sentencepiece

VOCAB_SIZE = 1024  # pi05_tiny's
OUT = Path(__file__).parent.parent / "src" / "turbopi" / "data" / "small_policy" / "tokenizer.model"

OBJECTS = """alphabet soup|basket|black bowl|blue block|book|bottle|bowl|box|bread|butter|cabbage|can|carrot|cheese
chocolate pudding|cloth|cookies box|corn|cream cheese|cream cheese box|cube|cup|dish|fork|frying pan|glass
green block|ketchup|knife|lid|marker|milk|moka pot|mug|napkin|orange juice|paper towel|pen|pen cap|pencil|plate|pot
ramekin|red block|red mug|salad dressing|screwdriver|shirt|sock|spatula|sponge|spoon|tape|tomato sauce|towel
tupperware|water bottle|white bowl|white mug|wine bottle|yellow and white mug|yellow block|apple|banana|lemon|orange
toy|remote|keys|cable"""
PLACES = """basket|bin|bottom drawer of the cabinet|bowl|box|cabinet|caddy|center of the table|counter|desk caddy
drawer|flat stove|middle drawer of the cabinet|microwave|plate|ramekin|sink|shelf|stove|table
top drawer of the cabinet|top of the cabinet|tray|wine rack|wooden cabinet|cookie box|dish rack|bag|container|slot
lid"""
RELATIONS = (
    "on|in|into|next to|near|to the left of|to the right of|in front of|behind|under|on top of|inside|from|above"
)
ACTIONS = """pick up the {a}|pick up the {a} and place it {r} the {p}|put the {a} {r} the {p}
put both the {a} and the {b} {r} the {p}|pick up the {a} between the {b} and the {p} and place it on the plate
pick up the {a} {r} the {p} and place it on the {q}|place the {a} {r} the {p}|move the {a} {r} the {p}
push the {a} to the front of the {p}|pull the {a}|open the {p}|close the {p}|open the {p} and put the {a} inside
turn on the {p} and put the {a} on it|turn off the {p}|put the {a} {r} the {p} and close it
put the {a} on the {p} and put the {b} on the {q}|pick the {a} and place it {r} the back compartment of the {p}
stack the {a} on the {b}|stack the blocks|wipe the {p} with the {a}|fold the {a}|unfold the {a}
pour the {a} into the {b}|take the {a} out of the {p}|remove the {a} from the {p}|insert the {a} into the {p}
transfer cube|insert the peg into the socket|open the {a}|close the {a}|uncap the {a}|hand over the {a}
grasp the {a} with the left arm|hold the {a} with the right hand|put the {a} in the {p} with both arms
rotate the {a}|flip the {a} upright|slide the {a} {r} the {p}|clean the {p}|do something|do nothing
find the {a} and bring it {r} the {p}|press the button|lift the {a} slowly|drop the {a} {r} the {p}"""
# Words that keep other text short, too, and each printable character, so that few need the byte fallback
OTHER_WORDS = """robot gripper arm arms hand wrist camera left right front back up down top bottom middle first
second small large big white black red green blue yellow pink purple brown grey orange hot cold full empty it this
that these those please then now again carefully slowly quickly gently without with before after while until all
every another one two three four five six seven eight nine ten kitchen table room living study bathroom bedroom
office floor door window wall light"""


def _split(text: str) -> list[str]:
    return text.replace("\n", "|").split("|")


def instructions(rng: random.Random) -> Iterator[str]:
    """Robot instructions from templates."""
    objects, places, relations, actions = map(_split, (OBJECTS, PLACES, RELATIONS, ACTIONS))
    for action in actions:
        for _ in range(80):
            a, b = rng.sample(objects, 2)
            p, q = rng.sample(places, 2)
            text = action.format(a=a, b=b, p=p, q=q, r=rng.choice(relations))
            yield rng.choice((text, text, text, text.capitalize(), text.capitalize() + "."))


def corpus(seed: int = 0) -> Iterator[str]:
    """The sentences to train on, the same for the same seed."""
    rng = random.Random(seed)
    for text in instructions(rng):
        state = " ".join(str(rng.randint(-1, 255)) for _ in range(rng.choice((7, 8, 8, 14))))
        yield text
        yield f"Task: {text}, State: {state};"
        yield "Action: "
    words = sorted(set(OTHER_WORDS.split()))
    for first, second in itertools.permutations(words, 2):
        if rng.random() < 0.05:
            yield f"{first} {second}"
    printable = "".join(map(chr, range(33, 127)))
    yield from [" ".join(printable), printable] * 5


def train() -> bytes:
    """The trained model, serialised."""
    model = io.BytesIO()
    sentencepiece.SentencePieceTrainer.train(
        sentence_iterator=corpus(),
        model_writer=model,
        model_type="bpe",
        vocab_size=VOCAB_SIZE,
        pad_id=0,
        eos_id=1,
        bos_id=2,
        unk_id=3,
        byte_fallback=True,
        character_coverage=1.0,
        normalization_rule_name="identity",
        remove_extra_whitespaces=False,
        add_dummy_prefix=False,
        split_digits=True,
        split_by_unicode_script=False,  # "Task:" and "State:" become one piece each
        user_defined_symbols=["\n"],
        num_threads=1,
        minloglevel=2,
    )
    return model.getvalue()


def main() -> None:
    out = Path(sys.argv[1]) if len(sys.argv) > 1 else OUT
    out.parent.mkdir(parents=True, exist_ok=True)
    model = train()
    out.write_bytes(model)
    print(f"{out}: {len(model)} bytes, SentencePiece {sentencepiece.__version__}")


if __name__ == "__main__":
    main()
