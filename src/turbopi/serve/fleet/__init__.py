"""Replicas of a policy on Ray Serve: the only files that know Ray."""
