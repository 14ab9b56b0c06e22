"""Research: one file a question, with what it takes to answer it again. Nothing else in Turbo-Pi imports this.

fp8_and_fp4.py    what numbers of eight and four bits do to actions (formats.py, weights.py)
certificates.py   FP8's certificates at full size, without a checkpoint
tensorrt.py       what layouts, attention and precisions cost inside TensorRT: `turbopi study`
"""
