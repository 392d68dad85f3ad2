"""Messages of lines t;r;u;y."""

from typing import Literal

from servoscope_spool import SpoolSettings, SpoolTransport

from servoscope.core.errors import MessageError
from servoscope.service.sources.inbox import Inbox
from servoscope.service.sources.message import Content, Decoder, SignalValue


class LineSettings(SpoolSettings):
    """The table `[sources.NAME]` of kind `lines`."""

    kind: Literal["lines"]
    payload: None = None  # nothing is to be said of where samples are

    def create(self, name, assets, folder):
        """Return the source: this decoder behind the transport of the spool."""
        return Inbox(SpoolTransport(folder / self.path), LineDecoder(assets), assets)


class LineDecoder(Decoder):
    """Values of r, u and y from lines of text."""

    block_s = 0.5

    def __init__(self, assets):
        self.assets = assets

    def find_asset(self, address):
        """Return the asset of an address, or an empty text."""
        asset, _, _ = address.partition("/")
        return asset if asset in self.assets else ""

    def decode(self, message):
        """Return the values of a message.

        Raises MessageError for a line that is not t;r;u;y.
        """
        values, asset = [], self.find_asset(message.address)
        for line in message.content.decode(errors="replace").splitlines():
            try:
                t, r, u, y = map(float, line.split(";"))
            except ValueError:
                raise MessageError("not a block", f"{line[:40]!r} is no t;r;u;y") from None
            values += [SignalValue(0, t, r), SignalValue(1, t, u), SignalValue(2, t, y)]
        return Content({asset: values} if asset else {}, complete=True)
