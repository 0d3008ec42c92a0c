"""Fit the cost of an iteration to measurements; a module of training.py and block_cost.py."""

from __future__ import annotations

import numpy as np
from scipy.optimize import nnls

from pipelines.core.types import FloatArray
from pipelines.jobs.costs import Work


def work_of(size: FloatArray) -> Work:
    """Return the work of an iteration with so many pixels, visible Gaussians and Gaussians."""
    return Work(megapixels=size[0] / 1e6, visible=size[1] / 1e6, gaussians=size[2] / 1e6)


def fitted_cost(sizes: FloatArray, measured: FloatArray) -> Work:
    """Return the cost of an iteration that fits measurements best in relative terms, with no part below zero.

    Sizes (B, 3) are pixels, visible and all Gaussians of each measurement (B,): seconds, or bytes at the peak.
    """
    terms = np.column_stack([np.ones(len(sizes)), sizes / 1e6])
    fixed, megapixels, visible, gaussians = nnls(terms / measured[:, None], np.ones(len(measured)))[0].tolist()
    return Work(fixed, megapixels=megapixels, visible=visible, gaussians=gaussians)
