"""Pi0-FAST: PaliGemma alone, which writes an action chunk as compressed tokens, one after the other."""
