"""A diagnosis as one self-contained HTML page with plots."""

from servoscope.report.document import page, write

__all__ = ["page", "write"]
