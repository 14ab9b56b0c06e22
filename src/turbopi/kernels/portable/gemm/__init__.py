"""Matrix products in Triton for every GPU of compute capability 8.0 and newer, with what follows them folded in."""
