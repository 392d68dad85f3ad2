"""Is this log usable for servoscope, and if not, why: everything that is measured on a recording, and the verdict."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np

from servoscope import alignment, excitation, leftover, levels, modelfit
from servoscope.alignment import Delay
from servoscope.excitation import Band, Excited, Spectra
from servoscope.inverse import cutoff_of
from servoscope.judgement import Finding, Verdict, judge, recommend
from servoscope.leftover import Residual
from servoscope.levels import BoolArray, DeadZone, DefectCount, Quantisation, Rest, Said, Sampling, Saturation
from servoscope.linear import settling
from servoscope.loop import DEFAULT_FREQUENCIES, Loop
from servoscope.modelfit import Fitted, FreeRun, IndexArray, OrderTried, Regressors
from servoscope.plants import FloatArray
from servoscope.recording import LEAST_SAMPLES, Recording

__all__ = ["Finding", "Fit", "Inspection", "Internals", "examine", "inspect"]
