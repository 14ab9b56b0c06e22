"""Benchmarks: the machine's floors first, then the policy's calls, then one JSON document with its provenance."""
