"""Compiles every kernel for every GPU, without one."""
