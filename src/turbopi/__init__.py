"""Turbo-Pi: Pi0.5 robot policies in real time, with openpi's exact semantics."""
