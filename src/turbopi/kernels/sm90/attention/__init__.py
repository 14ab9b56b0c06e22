"""Attention of vision, prefixes and suffixes by wgmma and TMA."""
