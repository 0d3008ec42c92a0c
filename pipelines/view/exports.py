"""A profile as CSV and DXF."""

import numpy as np

from pipelines.core.extras import require
from pipelines.core.json_values import Json
from pipelines.formats.tables import table_text
from pipelines.formats.vector_files import drawing
from pipelines.survey.target_crs import TargetCrs

_TYPES = {"csv": "text/csv; charset=utf-8", "dxf": "image/vnd.dxf"}
# Of the drawing: layer, number of σ above the surface, colour.
_LAYERS = (("PROFILE", 0, 7), ("PROFILE_PLUS_SIGMA", 1, 8), ("PROFILE_MINUS_SIGMA", -1, 8))


def profile_file(profile: Json, form: str, target: TargetCrs) -> tuple[bytes, str, str]:
    """Return a profile as a file: its bytes, their type, and a name.

    The drawing (DXF) has distances in metres as x and heights as y.

    Raises:
        BackendUnavailableError: a DXF without the extra `vectors`.
    """
    along, height, sigma_m = (
        np.array([np.nan if value is None else value for value in profile[name]], dtype=np.float64)
        for name in ("along_m", "height", "sigma_m")
    )
    if form == "dxf":
        require("vectors")
        lines = []
        for layer, factor, colour in _LAYERS:
            values = height + factor * sigma_m / target.crs.height_unit_m if factor else height
            known = np.isfinite(values)
            for part in np.split(np.arange(len(values)), np.flatnonzero(np.diff(known.astype(int))) + 1):
                if known[part].all() and len(part) > 1:
                    lines.append((layer, colour, np.column_stack([along, values])[part]))
        data = drawing(lines)
    else:
        names = ("longitude", "latitude") if target.crs.is_geographic else ("easting", "northing")
        rows = np.column_stack([along, np.array(profile["xy"]), height, sigma_m])
        cells = (["" if np.isnan(value) else f"{value:.10g}" for value in row] for row in rows)
        data = table_text([("distance_m", *names, "height", "sigma_m"), *cells]).encode()
    return data, _TYPES[form], f"profile.{form}"
