"""Times the tiles of the portable products."""
