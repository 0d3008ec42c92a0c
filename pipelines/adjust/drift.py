"""Drift of the fixes of a receiver without corrections: an error that neighbours in time share.

Errors of satellites' orbits and clocks, of the atmosphere and of reflections change within minutes, so that the
fixes of a few minutes err together. As independent errors they would average out, and a height that climbs by
metres over a flight would tilt the whole survey. The drift of a session is a Gauss–Markov process with a σ and a
time constant, less its mean, which the session's common error holds. Its covariance over the fixes has eigenvectors
(Karhunen–Loève), and few of them have almost all of its variance. Each is a systematic error of three components
with the same prior, its shape in time scaled by the root of its eigenvalue.
"""

import numpy as np

from pipelines.core.types import FloatArray

_KNOTS = 200  # instants at which the shapes are computed
_MODES, _VARIANCE = 12, 0.95  # most shapes, and the part of the variance that is enough
_LEAST_INSTANTS = 4
_INTERVAL_S = 2.0  # between photographs whose times are unknown


def drift_shapes(time_s: FloatArray, constant_s: float) -> FloatArray:
    """Return the shapes (F, K) of the drift of F fixes of a session, for factors of variance 1.

    Where a time (F,) is unknown, photographs follow each other at equal intervals. Too few instants have no shapes.
    """
    if not np.isfinite(time_s).all():
        time_s = _INTERVAL_S * np.arange(len(time_s), dtype=np.float64)
    instants = np.unique(time_s)
    if len(instants) < _LEAST_INSTANTS:
        return np.zeros((len(time_s), 0))
    knots = np.unique(np.quantile(time_s, np.linspace(0.0, 1.0, min(len(instants), _KNOTS))))
    covariance = np.exp(-np.abs(knots[:, None] - knots) / constant_s)
    covariance -= covariance.mean(axis=0)
    covariance -= covariance.mean(axis=1)[:, None]
    value, vector = np.linalg.eigh(covariance)
    value, vector = np.maximum(value[::-1], 0.0), vector[:, ::-1]
    count = int(np.searchsorted(np.cumsum(value), _VARIANCE * value.sum())) + 1
    shapes = np.sqrt(value) * vector
    return np.column_stack([np.interp(time_s, knots, shape) for shape in shapes.T[: min(count, _MODES)]])
