"""The engine: Pi0.5 for batch 1 with static shapes and packed weights, made to be captured in a CUDA graph."""
