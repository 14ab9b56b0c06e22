"""Matrix products by wgmma and TMA, in bfloat16 and E4M3, with what stands before and behind them."""
