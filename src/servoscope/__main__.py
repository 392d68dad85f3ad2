"""The command ``servoscope``, which is also ``python -m servoscope``: Ctrl-C ends it quietly at any moment."""

import os
import signal
import sys

EXIT_INTERRUPTED = 130  # exit code, as shells have it


def main() -> None:
    """Load the commands, and run the command line of this process."""
    is_interruptible = signal.getsignal(signal.SIGINT) is signal.default_int_handler  # not where it is ignored
    if is_interruptible:
        # loading takes a second, in which nothing is begun that would have to be ended
        signal.signal(signal.SIGINT, _end)
    from servoscope.cli import main as run_command

    try:
        if is_interruptible:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        run_command()
    except KeyboardInterrupt:
        sys.exit(EXIT_INTERRUPTED)
    finally:
        if is_interruptible:
            signal.signal(signal.SIGINT, _end)  # what is left to do is Python's


def _end(*_: object) -> None:
    os._exit(EXIT_INTERRUPTED)


if __name__ == "__main__":
    main()
