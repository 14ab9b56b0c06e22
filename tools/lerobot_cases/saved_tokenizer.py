"""What transformers makes of a tokenizer's folder, and whether the plugin's saved policy keeps it.

    PYTHONPATH=tools:src:plugins/lerobot_policy_turbopi/src \\
        .venv-lerobot/bin/python -m lerobot_cases.saved_tokenizer CHECKPOINT TEXTS.json

CHECKPOINT has the tokenizer in tokenizer/. The last line of output is JSON:

    ids        of each text, as LeRobot's tokenizer step gets them
    artifacts  whether this LeRobot saves tokenizers beside processors (after 0.6.1)
    kept       if it does: whether the processors of a saved plugin policy load, and give the same ids
"""

import json
import sys
from pathlib import Path
from typing import Any

from lerobot.policies.factory import make_pre_post_processors
from lerobot.processor import TokenizerProcessorStep
from lerobot_policy_turbopi import TurboPiConfig
from lerobot_policy_turbopi.modeling_turbopi import TurboPiPolicy
from transformers import AutoTokenizer


def main() -> None:
    checkpoint, texts = Path(sys.argv[1]), json.loads(Path(sys.argv[2]).read_text())
    ids = AutoTokenizer.from_pretrained(checkpoint / "tokenizer")(texts)["input_ids"]
    found: dict[str, Any] = {"ids": ids, "artifacts": hasattr(TokenizerProcessorStep, "save_artifacts")}
    if found["artifacts"]:
        saved = checkpoint.parent / "saved_with_tokenizer"
        config = TurboPiConfig(
            checkpoint=str(checkpoint), precision="f32", backend="pytorch", device="cpu", warmup=False
        )
        TurboPiPolicy(config).save_pretrained(saved)
        pre, _ = make_pre_post_processors(config, pretrained_path=str(saved))
        (step,) = (step for step in pre.steps if isinstance(step, TokenizerProcessorStep))
        found["kept"] = step.input_tokenizer(texts)["input_ids"] == ids
    print(json.dumps(found))


if __name__ == "__main__":
    main()
