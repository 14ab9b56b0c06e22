"""FP8 on real observations: which numbers a policy's products see, and what rounding them to E4M3 does to its actions.

    turbopi calibrate CKPT --observations RECORDING --out FILE     run.py      docs/quantization.md

sites.py       the places where numbers may be rounded, by name
statistics.py  what the float32 reference sees there, and the scales that follow
emulate.py     the reference with these places rounded exactly: what the error is measured with
artifact.py    the file: scales, plan, observations' and weights' hashes, report; refuses what it wasn't made for
"""
