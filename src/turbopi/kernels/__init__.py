"""Our own GPU kernels. CUDA C++ is compiled when first needed, without nvcc, and the result is cached on disk."""
