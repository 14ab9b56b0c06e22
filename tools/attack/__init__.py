"""Attack a policy server, and all that reads files and command lines. See `python -m attack --help`."""
