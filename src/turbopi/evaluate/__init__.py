"""Closed-loop evaluation: a policy acts in a simulator, and its success is counted with confidence intervals."""
