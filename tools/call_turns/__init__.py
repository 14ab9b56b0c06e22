"""Whole calls in variants, timed in turns, and the timeline of one: `python -m call_turns --help`."""
