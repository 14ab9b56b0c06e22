"""What turbopi-lab's tests share with Turbo-Pi's: tests/shared.py."""

from shared import (  # noqa: F401
    GOLDEN,
    _own_fingerprints,
    cubins,
    drawn,
    golden,
    golden_cases,
    golden_folder,
    golden_model,
    gpu_or_interpreter,
    on_hopper,
    packed_arrays,
    two_layers,
    two_threads,
    unseen_plots,
)
