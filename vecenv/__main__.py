"""``python -m vecenv``: the same as the command ``vecenv``."""

from vecenv.cli import main

if __name__ == "__main__":
    main()
