"""Check points with a wrong mark or coordinate: they miss the solution far beyond σ, while the others agree.

The standard's own rule, three times the class of the others, needs several points and knows no σ. The rule here
compares each point with its prediction from the solution *and from the other check points*, so that an error which
all share, such as that of the base station, accuses none.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipelines.core.figures import length_text
from pipelines.core.products import Remark
from pipelines.core.sentences import listed
from pipelines.core.types import BoolArray, FloatArray

# A blunder misses by more than this many σ, and by so many times what the others scatter. Errors of points that
# are only poorly predicted stay below: their σ is at fault then, and `chi2_caution` says so.
_SIGMAS = 5.0
_AXES = 3


@dataclass(frozen=True)
class Blunders:
    """Masks (J,) of the points that are wrong, and of those of which one is wrong, without telling which."""

    wrong: BoolArray
    doubtful: BoolArray


def find_blunders(error_in_geo: FloatArray, joint_cov: FloatArray) -> Blunders:
    """Return the blunders among J ≥ 1 errors (J, 3), whose joint covariance is (3 J, 3 J), survey included.

    1. Each point's misfit is its error less what the other points predict of it, in σ.
    2. The largest misfit is a blunder if it exceeds five σ, also after the others' own scatter has scaled σ.
    3. Of two points, the blunder is the one whose own error does so; if none does, either may be wrong.
    4. Without the blunder, the rule is applied again, until more than half of the points would be left out.

    A single point is none: nothing tells whether the point or the solution is wrong.
    """
    error = np.asarray(error_in_geo, dtype=np.float64)
    wrong, doubtful = np.zeros((2, len(error)), dtype=bool)
    while (rows := np.flatnonzero(~wrong)).size >= 2 and wrong.sum() < len(error) / 2:
        misfit = _misfits(error[rows], _part(joint_cov, rows))
        scatter = np.array([_scatter(error[row], _part(joint_cov, np.array([row]))) for row in rows])
        worst = rows[np.argmax(scatter if len(rows) == 2 else misfit)]
        others = rows[rows != worst]
        allowed = _SIGMAS * max(_scatter(error[others], _part(joint_cov, others)), 1.0)
        if misfit[rows == worst] <= allowed:
            break
        if len(rows) == 2 and scatter[rows == worst] <= allowed:
            doubtful[rows] = True
            break
        wrong[worst] = True
    return Blunders(wrong, doubtful)


def _part(joint_cov: FloatArray, rows: np.ndarray) -> FloatArray:
    columns = (_AXES * rows[:, None] + np.arange(_AXES)).ravel()
    return joint_cov[np.ix_(columns, columns)]


def _misfits(error: FloatArray, cov: FloatArray) -> FloatArray:
    """Return for each point (J,) the length of its error less the others' prediction of it, in σ per axis."""
    information = np.linalg.inv((cov + cov.T) / 2)
    pulled = (information @ error.ravel()).reshape(-1, _AXES)
    of_point = np.stack([information[k : k + _AXES, k : k + _AXES] for k in range(0, len(cov), _AXES)])
    squared = np.einsum("ji,ji->j", pulled, np.linalg.solve(of_point, pulled[..., None])[..., 0])
    return np.asarray(np.sqrt(np.maximum(squared, 0.0) / _AXES))


def _scatter(error: FloatArray, cov: FloatArray) -> float:
    """Return how many times their σ the errors of points are, root mean square."""
    flat = error.ravel()
    squared = float(flat @ np.linalg.solve((cov + cov.T) / 2, flat))
    return float(np.sqrt(max(squared, 0.0) / len(flat)))


def blunder_caution(names: Sequence[str], error_in_geo: FloatArray, blunders: Blunders) -> tuple[Remark, ...]:
    """Return the caution that names the check points that are wrong, with their errors; none without any."""
    sizes = [
        f"{name} ({length_text(float(np.hypot(*error[:2])))} horizontally, {length_text(abs(float(error[2])))} "
        "vertically)"
        for name, error in zip(names, error_in_geo, strict=True)
    ]
    remarks = []
    if blunders.wrong.any():
        bad = [size for size, is_wrong in zip(sizes, blunders.wrong, strict=True) if is_wrong]
        rest = len(sizes) - len(bad)
        sentence = (
            f"{len(bad)} of {len(sizes)} check points disagree{'s' if len(bad) == 1 else ''} with the solution far "
            f"beyond σ, while the other {rest} agree{'s' if rest == 1 else ''}: {listed(bad)}. Check coordinate, "
            "name and marks. The accuracy is stated with and without."
        )
        remarks.append(Remark(code="check-point-blunder", sentence=sentence))
    if blunders.doubtful.any():
        pair = [size for size, is_doubtful in zip(sizes, blunders.doubtful, strict=True) if is_doubtful]
        sentence = (
            f"The check points {listed(pair)} contradict each other far beyond σ: one of them is wrong, and a "
            "third one would tell which. Check coordinates, names and marks."
        )
        remarks.append(Remark(code="check-points-contradict", sentence=sentence))
    return tuple(remarks)
