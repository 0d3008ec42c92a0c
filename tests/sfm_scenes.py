"""Small synthetic photographs for `sfm`, and their survey."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pipelines.geodesy.enu import Origin
from pipelines.geodesy.vertical import VerticalDatum
from pipelines.sfm.options import SfmOptions
from pipelines.simulate.options import SimulateOptions
from pipelines.survey.survey import CameraPrior, Survey, SurveyImage

IMAGES, WIDTH, HEIGHT = 10, 240, 180
FOCAL = 0.85 * WIDTH
CONFIG = SfmOptions(max_features=1000, camera_model="SIMPLE_RADIAL", threads=1)
FLIGHT = SimulateOptions(
    images=IMAGES,
    size=f"{WIDTH}x{HEIGHT}",
    flight="grid",
    heights=(60.0,),
    radius=20.0,
    focal=0.85,
    lens="pinhole",
    noise=0.2,
    targets=0,
    control=0,
)


@dataclass(frozen=True)
class Photographs:
    """A folder of photographs, and where they were taken."""

    folder: Path
    center_in_geo: dict[str, list[float]]

    @property
    def names(self) -> list[str]:
        return sorted(self.center_in_geo)


def survey_of(names: list[str], image_dir: str = "photos") -> Survey:
    prior = CameraPrior(
        camera_id=1,
        model="SIMPLE_RADIAL",
        width=WIDTH,
        height=HEIGHT,
        params=(FOCAL, WIDTH / 2, HEIGHT / 2, 0.0),
        focal_source="calibrated",
    )
    return Survey(
        origin=Origin(lat_deg=46.0, lon_deg=7.0, alt_m=400.0),
        source_crs="EPSG:4979",
        vertical=VerticalDatum(name="ellipsoidal", stated=True),
        image_dir=image_dir,
        cameras=(prior,),
        images=tuple(SurveyImage(name=name, camera_id=1, sha256="") for name in names),
    )
