"""Files to recordings: CSV, Parquet, MAT, MDF, TDMS; which columns are r, u, y and t."""

from servoscope.signals.readers.addresses import is_address
from servoscope.signals.readers.formats import readable_suffixes
from servoscope.signals.readers.recording_file import (
    ChannelInfo,
    as_recording,
    list_channels,
    read,
    read_parts,
    read_rows,
)

__all__ = [
    "ChannelInfo",
    "as_recording",
    "is_address",
    "list_channels",
    "read",
    "read_parts",
    "read_rows",
    "readable_suffixes",
]
