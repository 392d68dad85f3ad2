"""Files to recordings: CSV, Parquet, MAT, MDF, TDMS; which columns are r, u, y and t."""

from servoscope.readers.reading import SUFFIXES, ChannelInfo, channels, read, read_parts

__all__ = ["SUFFIXES", "ChannelInfo", "channels", "read", "read_parts"]
