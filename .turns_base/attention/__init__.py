"""Attention of vision and prefix by wgmma and TMA."""
