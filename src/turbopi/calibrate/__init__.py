"""FP8, INT8, NVFP4 on real observations: which numbers a policy's products see, and what that does to its actions.

    turbopi calibrate CKPT --observations RECORDING --out FILE     run.py      docs/quantization.md

observations.py    what is measured on, and what is held out
statistics.py      what the float32 reference sees at the sites, and the scales that follow
product_errors.py  what rounding does to each site's own products
report.py          what the file says of how it was made

The reference with its sites rounded exactly is engine/emulate.py; the file that is written,
quantization/calibration_file.py.
"""
