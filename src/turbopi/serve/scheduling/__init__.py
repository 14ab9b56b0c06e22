"""Whose turn it is on the policy: a pure schedule, the times that it plans with, and the thread that runs it."""
