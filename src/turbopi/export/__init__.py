"""The model in formats that other runtimes read."""
