"""Kernels that run on every NVIDIA GPU: in Triton, and the library's products."""
