"""Options of everything whose coordinates are in a CRS."""

from __future__ import annotations

from pydantic import Field

from pipelines.core.options import StageOptions
from pipelines.geodesy.vertical import Vertical


class CrsOptions(StageOptions):
    """Options of every file whose coordinates are in a CRS."""

    crs: str | None = Field(
        None,
        description="CRS of the file: EPSG:32632, EPSG:32632+3855, a PROJ string or WKT. Without it: the UTM zone "
        "of the scene.",
    )
    vertical: Vertical | None = Field(
        None,
        description="Datum of the heights where --crs is silent: ellipsoidal, EGM96, EGM2008 or EPSG:n. Without "
        "it: that of the survey.",
    )
