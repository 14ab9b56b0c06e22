"""What the examples call of openpi's client, for tests where it isn't installed."""
