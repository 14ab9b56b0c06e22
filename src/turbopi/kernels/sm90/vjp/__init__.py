"""Products on the expert's way back for up to 16 tokens, for compute capability 9.0: see across.cu."""
