"""Before and after the model: images resized, states and actions normalised, prompts tokenised (pipeline.py)."""
