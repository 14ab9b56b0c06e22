"""Other programs beside Turbo-Pi, on one GPU and in one run: `python -m peers --help`."""
