"""Makes small LeRobot checkpoints and records what LeRobot's own code computes with them; see __main__.py."""
