"""The action expert on few tokens, forward and back, in kernels that stream each matrix once: see `ops.py`."""
