"""A survey and its SfM model as the files of a surveyor: what `georef run` reads."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from pipelines.formats.colmap import write_sparse
from pipelines.geodesy.enu import Origin, lla_from_enu
from pipelines.geometry.sparse_model import SparseModel
from pipelines.survey.survey import Survey, SurveyedPoint, SurveyImage
from tests.photos import jpeg

# The shortest training that leaves a splat: the statement of accuracy does not depend on its photographs.
QUICK = """[train]
iterations = 10
max_image_size = 48
max_gaussians = 200
sh_degree = 0
dense = false
exposure = false
[evaluate]
renders = 0
"""


def write_survey(folder: Path, survey: Survey, model: SparseModel) -> tuple[object, ...]:
    """Write photographs of noise, trajectory, control and check points and the model; return `run`'s arguments."""
    photos = folder / "photos"
    photos.mkdir(parents=True)
    camera = model.camera_of(0)
    # Photographs of one size decode to the same pixels but for one: they only have to be different files.
    plain = jpeg(0, size=(camera.width, camera.height))
    for index, name in enumerate(model.image_name):
        (photos / name).write_bytes(plain + bytes([index]))
    write_sparse(model, folder / "model")
    arguments: list[object] = [
        "--images", photos, "--import", folder / "model", "--vertical", "ellipsoidal", "--test-every", "0",
        "--sigma-mark", "0.3",
    ]  # fmt: skip
    rows = [_row(image, survey.origin) for image in survey.images if image.fix is not None]
    if rows:
        head = "image,timestamp,latitude,longitude,altitude,sigma_e,sigma_n,sigma_u"
        attitudes = all(image.attitude is not None for image in survey.images)
        table = [head + (",qx,qy,qz,qw" if attitudes else ""), *rows]
        (folder / "track.csv").write_text("\n".join(table) + "\n")
        arguments += ["--trajectory", folder / "track.csv", "--sigma-attitude", "0.5"]
    for option, points in (("--gcp", survey.control_points), ("--checkpoints", survey.check_points)):
        if points:
            path = folder / f"{option.strip('-')}.txt"
            path.write_text("\n".join(["EPSG:4979", *_marks(points, survey.origin)]) + "\n")
            arguments += [option, path]
    return tuple(arguments)


def _row(image: SurveyImage, origin: Origin) -> str:
    assert image.fix is not None
    lat, lon, alt = lla_from_enu(np.array(image.fix.position_in_geo), origin)
    sigma = np.sqrt(np.diag(image.fix.cov_in_geo))
    values = [image.timestamp_s or 0.0, lat, lon, alt, *sigma]
    values += [] if image.attitude is None else image.attitude.quat_xyzw
    return ",".join([image.name, *(f"{value:.12g}" for value in values)])


def _marks(points: Iterable[SurveyedPoint], origin: Origin) -> list[str]:
    rows = []
    for point in points:
        lat, lon, alt = lla_from_enu(np.array(point.position_in_geo), origin)
        rows += [
            f"{lon:.12f} {lat:.12f} {alt:.6f} {mark.x_px:.6f} {mark.y_px:.6f} {mark.image} {point.name}"
            for mark in point.marks
        ]
    return rows
