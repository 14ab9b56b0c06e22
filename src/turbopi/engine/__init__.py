"""The engine: Pi0.5 for one observation or several, with static shapes and packed weights, captured as CUDA graphs."""
