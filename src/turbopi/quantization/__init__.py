"""Numbers of eight bits: what they are, where a model may have them, and the file that says which it gets.

fp8.py               E4M3; matrices of numbers of eight bits with their scales
int8.py              whole numbers of eight bits
formats.py           both, by name
rounding.py          weights rounded so that their errors cancel; directions.py: what that takes of activations
sites.py             the places where numbers may be rounded, by name
plan.py              what runs in which precision
calibration_file.py  the file that calibration writes: scales, plan, hashes, report; refuses what it wasn't made for
"""
