"""A load test of policy servers: `python -m load_test --help`."""
