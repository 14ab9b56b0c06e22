"""`python -m turbopi` and the console script `turbopi`."""

import os


def main() -> None:
    try:
        from turbopi.cli import main as run
    except KeyboardInterrupt:  # the import takes a while, too
        os._exit(130)
    run()


if __name__ == "__main__":
    main()
