"""Accuracy figures, each defined once (label, meaning, unit, decimals); and the headline, the accuracy of a result.

Tables, pages and sentences take their words and decimals from here, so that one figure has one name and the same
digits everywhere. `survey.headline` says which figure is the headline of a workspace.
"""

import math
from dataclasses import dataclass
from typing import Literal

from pipelines.core.products import Product
from pipelines.core.sentences import listed

MISSING = "–"
# How the position of a check point was measured, by the key of the report.
WAYS = {"triangulated": "triangulated", "surface": "on the rendered surface"}


def length_text(metres: float | None) -> str:
    """Return an estimated length with its unit: `4.2 cm`, `2.57 m`, `31.4 m`, `412 m`; a dash for None.

    The unit follows from the rounded value: from one metre on, lengths are in metres.
    """
    if metres is None or not math.isfinite(metres):
        return MISSING
    size = abs(metres)
    if round(100.0 * size, 1) < 100.0:
        return f"{100.0 * metres:.1f} cm"
    return f"{metres:.{2 if size < 9.995 else 1 if size < 99.95 else 0}f} m"


@dataclass(frozen=True)
class Figure:
    """Accuracy figure: `label` heads its column, `meaning` its row; unit and decimals are those of its text.

    The unit is empty for a number of points, and for a length whose text has its own (`length_text`).
    """

    label: str
    meaning: str
    unit: Literal["m", ""] = "m"
    decimals: int | None = 3

    def text(self, value: float | None) -> str:
        """Return a value as text without the unit of the figure; lengths are given in metres. A dash for None."""
        if self.decimals is None:
            return length_text(value)
        return MISSING if value is None else f"{value:.{self.decimals}f}"

    def with_unit(self, value: float | None) -> str:
        """Return a value as text with its unit; a dash for None."""
        return self.text(value) if value is None else f"{self.text(value)} {self.unit}".rstrip()


# Figures of the headline, as `Headline` explains them.
ACCURACY_H = Figure("H", "horizontal accuracy", "", None)
ACCURACY_V = Figure("V", "vertical accuracy", "", None)
CHECK_POINTS = Figure("checks", "check points that the accuracy was measured at", "", 0)
# Errors of surveyed points, by field of `survey.report.ErrorStats`.
ERRORS = {
    "count": Figure("points", "points", "", 0),
    "mean_e_m": Figure("mean E", "mean error east (bias)"),
    "mean_n_m": Figure("mean N", "mean error north (bias)"),
    "mean_u_m": Figure("mean U", "mean error up (bias)"),
    "rmse_e_m": Figure("RMSE E", "RMSE east"),
    "rmse_n_m": Figure("RMSE N", "RMSE north"),
    "rmse_h_m": Figure("RMSE H", "RMSE horizontal"),
    "rmse_v_m": Figure("RMSE V", "RMSE vertical"),
    "rmse_3d_m": Figure("RMSE 3D", "RMSE in three dimensions"),
    "mean_h_m": Figure("mean H", "mean horizontal error"),
    "median_h_m": Figure("median H", "median horizontal error"),
    "max_h_m": Figure("max H", "largest horizontal error"),
    "max_v_m": Figure("max V", "largest vertical error"),
    "max_3d_m": Figure("max 3D", "largest error in three dimensions"),
}
# Errors of the surface at measured points that the training was not given, by field of
# `survey.lidar_report.DepthErrors`.
DEPTH_ERRORS = {
    "points": Figure("points", "held-out measured points at which both surfaces are known", "", 0),
    "bias_m": Figure("bias", "median error along the points' normals; above zero: in front of the points"),
    "median_m": Figure("median", "median magnitude of the error"),
    "abs_90_m": Figure("90 %", "magnitude that nine of ten errors do not exceed"),
}
# Predicted σ over the cells of the scene, by the prefix of the fields of `survey.report.AccuracySummary`.
CELLS = {
    "least": Figure("least", "σ of the best cell of the scene"),
    "median": Figure("median", "median σ over the cells of the scene"),
    "rms": Figure("RMS", "root mean square of σ over the cells of the scene"),
    "largest": Figure("largest", "σ of the worst cell of the scene"),
}


def _checks(count: int) -> str:
    return f"{count} check point{'s'[: count != 1]}"


class SurfaceErrors(Product):
    """RMSE of the surface's height at some check points, their survey's error included."""

    check_points: int
    rmse_v_m: float


class SurfaceAccuracy(Product):
    """Accuracy of the surface, as the DSM shows it from above, at check points outside vegetation.

    Attributes:
        ground, raised: at points on the ground, and on roofs and whatever else stands on it; None: there are none.
        anywhere: at points of which neither is known.
        unseen: number of points at edges, below other surfaces, or where views do not agree on one.
    """

    ground: SurfaceErrors | None = None
    raised: SurfaceErrors | None = None
    anywhere: SurfaceErrors | None = None
    unseen: int = 0

    @property
    def parts(self) -> tuple[tuple[str, str, SurfaceErrors], ...]:
        """Where the points lie, in words and as the name of the field, and their errors."""
        words = {"on the ground": "ground", "on roofs and other raised places": "raised", "": "anywhere"}
        return tuple((where, key, getattr(self, key)) for where, key in words.items() if getattr(self, key))

    @property
    def text(self) -> str:
        """`RMSE V 5.2 cm on the ground (6 check points), V 31.0 cm on roofs and other raised places (3)`."""
        parts = [
            f"V {ACCURACY_V.with_unit(errors.rmse_v_m)} {where}".rstrip()
            + f" ({errors.check_points if number else _checks(errors.check_points)})"
            for number, (where, _, errors) in enumerate(self.parts)
        ]
        return f"RMSE {', '.join(parts)}" + (
            f"; none at {self.unseen} more, on walls, under roofs or unseen" if self.unseen else ""
        )


class ToleranceTest(Product):
    """Required accuracy against what check points outside vegetation measure, their survey's error included.

    After the ASPRS standard (`evaluate.asprs`), a product passes if its RMSE is at most what is required, at as
    many points as the standard demands. `met`: fewer points; `untested`: none.
    """

    of: str
    tolerance_m: float
    rmse_m: float | None
    check_points: int
    least_points: int
    verdict: Literal["pass", "fail", "met", "untested"]

    @property
    def sentence(self) -> str:
        """Such as `vertical, triangulated: RMSE 4.2 cm of 5.0 cm at 9 check points: met, no pass: …`."""
        text = f"{self.of}: required RMSE {length_text(self.tolerance_m)}"
        if self.verdict == "untested":
            return f"{text}, not tested: no check point measures it"
        text += f", measured {length_text(self.rmse_m)} at {_checks(self.check_points)}"
        few = f"met, but no pass: the standard demands {self.least_points} check points"
        return f"{text}: {few if self.verdict == 'met' else self.verdict}"


class Headline(Product):
    """The accuracy of a result: the figures that every table, page and file states of it (docs/accuracy.md).

    They are two: of points that are triangulated in photographs, and of the surface (`surface`).

    Attributes:
        kind: `measured`: of the triangulated check points; `predicted`: of the scene; `unknown`: neither.
        rmse_h_m, rmse_v_m: RMSE of the check points, their survey's error included, or the root mean square of the
            predicted σ over the scene. None: not known, such as V where heights count from an unknown take-off.
        check_points: number of check points; 0 unless measured.
        reason: reason why it is not known; None: it is.
        vegetated: number of further check points, which lie under vegetation and do not count.
        beyond_class: of the check points, number of those whose error exceeds three times the class that the others
            meet, although they are not refuted; they count in RMSE and number.
        blunders: names of the check points that the others and σ refute; they count in RMSE and number.
        rmse_h_without_m, rmse_v_without_m: RMSE without the blunders. None: there are none, or no other point.
        surface: accuracy of the surface; None: no check point measures it.
    """

    kind: Literal["measured", "predicted", "unknown"]
    rmse_h_m: float | None = None
    rmse_v_m: float | None = None
    check_points: int = 0
    reason: str | None = None
    vegetated: int = 0
    beyond_class: int = 0
    blunders: tuple[str, ...] = ()
    rmse_h_without_m: float | None = None
    rmse_v_without_m: float | None = None
    surface: SurfaceAccuracy | None = None

    @property
    def text(self) -> str:
        """Both figures: `predicted, not measured: σ H 4.2 cm, V 5.1 cm; of the surface: RMSE V 6.3 cm …`."""
        return self.of_points + (f"; of the surface: {self.surface.text}" if self.surface is not None else "")

    @property
    def of_points(self) -> str:
        """Kind and figures of the points, with which points they are, and by which measurement.

        Such as `measured at 9 check points, triangulated, with the error of their survey: RMSE H 4.2 cm, V 5.1 cm`.
        """
        if self.kind == "unknown":
            return f"not known: {self.reason}"
        vertical = "unknown" if self.rmse_v_m is None else ACCURACY_V.with_unit(self.rmse_v_m)
        figures = f"H {ACCURACY_H.with_unit(self.rmse_h_m)}, V {vertical}"
        if self.kind == "predicted":
            return f"predicted, not measured: σ {figures}"
        where = f"{_checks(self.check_points)}{' outside vegetation' if self.vegetated else ''}"
        text = f"measured at {where}, triangulated, with the error of their survey: RMSE {figures}"
        if self.beyond_class:
            text += f"; {self.beyond_class} of them exceed three times the class of the others, and count"
        if self.rmse_h_without_m is None:
            return text
        others = f"H {ACCURACY_H.with_unit(self.rmse_h_without_m)}, V {ACCURACY_V.with_unit(self.rmse_v_without_m)}"
        return f"{text}; without {listed(self.blunders)}, which the others refute: RMSE {others}"

    @property
    def sentence(self) -> str:
        return f"accuracy {self.text}"
