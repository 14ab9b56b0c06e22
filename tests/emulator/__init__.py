"""Runs the CUDA C++ of our kernels for Hopper on a CPU, thread by thread: see machine.h."""
