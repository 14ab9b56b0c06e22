"""The denoising loop in one cooperative kernel for compute capability 8.0 and newer."""
