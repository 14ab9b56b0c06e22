"""Before and after the model: pictures resized, states and actions normalised, prompts tokenised (pipeline.py)."""
