"""The monitor of one baseline as source text for the firmware of a drive."""

from servoscope.export.c_monitor import NAME, UNSEEN_MOTION, CMonitor, export_c
from servoscope.export.fmu import export_fmu
from servoscope.export.image import pack_image, unpack_image
from servoscope.export.st_monitor import export_st, save_st

__all__ = [
    "NAME",
    "UNSEEN_MOTION",
    "CMonitor",
    "export_c",
    "export_fmu",
    "export_st",
    "pack_image",
    "save_st",
    "unpack_image",
]
