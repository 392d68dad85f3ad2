"""One warning where no folder for caches can be written, in the place of what each library says of it."""

from __future__ import annotations

import functools
import logging
import multiprocessing

from servoscope.core.messages import message, render

logger = logging.getLogger(__name__)


@functools.cache
def warn_of_missing_cache() -> None:
    """Log, once, that results which libraries keep for the next start are lost."""
    if multiprocessing.parent_process() is None:  # the processes of a pool would repeat it
        logger.warning(render(message("core.no_cache")))


def replace_library_warnings() -> None:
    """Let our warning take the place of Matplotlib's; for processes that are servoscope's own."""
    logging.getLogger("matplotlib").addFilter(_is_other_warning)


def _is_other_warning(record: logging.LogRecord) -> bool:
    is_folder = record.levelno == logging.WARNING and any(
        words in str(record.msg)
        for words in ("mkdir -p failed", "temporary cache directory", "not a writable directory")
    )
    if is_folder:
        warn_of_missing_cache()
    return not is_folder
