"""`python -m turbopi` is `turbopi`."""

from turbopi.cli import main

main()
