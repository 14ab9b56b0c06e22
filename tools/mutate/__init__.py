"""Plants faults into a copy of the tree, one at a time, and runs the CPU tests that should find them.

`PYTHONPATH=src:tests:tools python -m mutate --help`
"""
