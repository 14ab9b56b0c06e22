"""How far from the float32 reference a backend's actions may be.

The oracle is the eager reference in float32, given the same weights, observations and noise. How far a
bfloat16 run may be from it depends on the model, so the bound is measured on the model itself: a *control* runs the
oracle again with each weight that bfloat16 would round moved at random by up to half a bfloat16 step (2^-9 of its
value), in float32 arithmetic: that is how much this model makes of rounding. A bfloat16 run rounds its activations,
too, and lands at 0.7 to 3.2 times the control (66 chunks of `pytorch` and `pytorch_compile`; random pi05_tiny of four
seeds, openpi's golden Pi0.5 and Pi0; 1, 3 and 10 steps). The bound is 5 times the control. On pi05_tiny one wrong
prompt token lands at 8 times, swapped cameras at 16, and attended padding, a lost camera mask or BGR beyond 75.

Trained weights make more of rounded activations, beside rounded weights: the small policy of 0.1.0 landed at 1.2 to 5.5
times its control (18 chunks), so for them the bound is 10 times. Of its chunks, one wrong word moves the worst to 73
times, swapped cameras or BGR every one beyond 130.

Float32 rounds 2^16 times finer, and so is its control. Compiled float32 lands at 5 to 10 times that; the bound is 30,
since every way of adding up differs, and bugs are as much further off.
"""

from turbopi.backends import Precision
from turbopi.quantization.plan import ROUNDED

# times the control (control.py), for actions in the model's units
BOUND_FACTORS: dict[Precision, float] = {"bf16": 5.0, "f32": 30.0, **dict.fromkeys(ROUNDED, 5.0)}
TRAINED_FACTORS: dict[Precision, float] = BOUND_FACTORS | {"bf16": 10.0}

# of `turbopi verify`
F32_BOUND = 1e-5  # relative rms of the actions
BF16_FACTOR = 1.25  # times the bf16 control's
# of FP8 and of INT8
FP8_BOUND = 0.0707  # relative rms of the actions: a cosine of 0.9975
FP8_COSINE = 0.9975  # of what denoising did (actions less noise): what calibration aims at
# E4M3's rounding is so much coarser than bfloat16's, and so may intermediates be. int8's is a dozen times as coarse
# for a normal variable; with outliers, which its scale has to hold, more
STEPS: dict[str, float] = {**dict.fromkeys(ROUNDED, 2.0**5), "nvfp4": 2.0**7}  # E2M1 has two bits less than E4M3
SUSPECT_FACTOR = 3.0  # times the control's, on an intermediate
JUMP = 10.0  # times the layer or step before
FLOAT32_ROUNDING = 1e-6  # relative rms: where the control stays in float32 it may have no error at all
