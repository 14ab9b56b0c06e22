"""Judging a backend: against openpi's own numbers, and against the float32 reference."""
