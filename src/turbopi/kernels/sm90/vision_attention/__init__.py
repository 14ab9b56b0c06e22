"""The vision tower's q|k|v product and self-attention in one kernel, for compute capability 9.0."""
