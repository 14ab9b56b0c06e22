"""The tuner: which tiles are the fastest on this GPU, measured. `turbopi tune` shows it.

shapes.py says which operations a model's calls have, race.py measures candidates in turns and decides, gpu.py is the
clock and the memory around them, portable.py and hopper.py are the operations themselves, run.py puts it together.
"""
