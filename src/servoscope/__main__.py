"""``python -m servoscope``: the same as the command ``servoscope``."""

from servoscope.cli import main

if __name__ == "__main__":
    main()
