"""A diagnosis as one self-contained HTML page with plots."""

from servoscope.report.diagnosis_page import render_diagnosis_page, write_diagnosis_page

__all__ = ["render_diagnosis_page", "write_diagnosis_page"]
