"""The models: a folder for each family, with its reference. `observation.py` is what all of them take."""
