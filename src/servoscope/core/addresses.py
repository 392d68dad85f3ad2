"""How an address is shown: scheme, host and port, for user, path and query may hold passwords and tokens."""

from __future__ import annotations

import re
from urllib.parse import urlsplit

# up to the next space, for a password may hold quotes; punctuation that follows is the text's own
URLS = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*://\S*?(?=[\"'.,:;)\]}>]*(?:\s|$))")


def show_address(url: str) -> str:
    """Return scheme, host and port of a URL; of what is none, only that it is hidden."""
    try:
        parts = urlsplit(url)
        host, port = parts.hostname or "", parts.port
    except ValueError:  # a port that is no number, brackets that do not close
        return f"{url.partition('://')[0]}://..." if URLS.match(url) else "..."
    if not parts.scheme or "://" not in url:
        return "..."
    host = f"[{host}]" if ":" in host else host
    return f"{parts.scheme}://{host or '...'}" + (f":{port}" if port is not None else "")


def hide_secrets(text: str) -> str:
    """Return a text with each URL in it as `show_address` shows it."""
    return URLS.sub(lambda match: show_address(match[0]), text)
