"""Norms for Hopper."""
