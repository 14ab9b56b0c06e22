"""`python -m turbopi.cli`: the command line where the console script isn't installed."""

from turbopi.cli import main

main()
