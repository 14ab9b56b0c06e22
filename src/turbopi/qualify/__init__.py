"""What the process does that finds out whether backend `fused` is right and fast on a GPU that no test ever ran on.

`backends/qualifying.py` starts it, ends it when it hangs, and keeps what it found.
"""
