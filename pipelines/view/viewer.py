"""The viewer's answers: what a page shows of a trained model, measures in it, saves and marks.

A page has its own state. The viewer has the model, the saved measurements and the marks, which all pages share.
"""

import threading
from collections.abc import Iterator
from dataclasses import asdict, replace
from typing import Any

import cv2
import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.json_values import Json
from pipelines.core.manifest import hash_file
from pipelines.core.progress import SILENT, Progress
from pipelines.core.stages import GAUSSIANS, MODEL
from pipelines.core.types import ByteArray, FloatArray
from pipelines.core.workspace import Workspace
from pipelines.geodesy.enu import lla_from_enu
from pipelines.report.page import limited
from pipelines.surface.picking import NoSurface, SurfacePoint
from pipelines.surface.surface_views import ModelRenderer, model_renderer
from pipelines.survey.marks import mark_rays, wrong_marks
from pipelines.survey.navigation import load_survey
from pipelines.survey.saved_measurements import NamedMeasurement, Quantity, SavedPoint, new_id
from pipelines.survey.solution import read_sfm, read_trained
from pipelines.survey.survey import SurveyedPoint
from pipelines.view import requests
from pipelines.view.mark_views import epipolar_lines, proposals
from pipelines.view.marking import (
    KeptMarks,
    MarkedPoint,
    appears_in,
    points_to_mark,
    rays_of,
    residuals_px,
    surveyed_marks,
)
from pipelines.view.measuring import ESTIMATE, Fineness, MeasuringModel, pointing_covariance
from pipelines.view.options import ViewOptions
from pipelines.view.page_scene import described_scene
from pipelines.view.pictures import PageView, Painter, Photographs, frame_of
from pipelines.view.quantities import Profile, distances, length
from pipelines.view.saved import FOLDER, SavedMeasurements
from pipelines.view.work import Jobs, ViewJob

_PIXEL_MARGIN = 0.02  # of a photograph: nearer to its rim a place is seen badly
_MOST_SEEN = 24  # photographs in the strip


class Viewer:
    """Viewer of a workspace, until the model changes.

    Raises:
        MissingProductError: there is no trained model; names the command that makes it.
        GeorefError: a product is damaged, or the CRS cannot be used.
    """

    def __init__(self, workspace: Workspace, options: ViewOptions, progress: Progress = SILENT) -> None:
        self.stamp = model_stamp(workspace)
        self._workspace = workspace
        with progress.task("reading the model", 2) as task:
            solution = read_trained(workspace)
            sfm, survey = read_sfm(workspace, solution), solution.weighted(load_survey(workspace))
            task.advance()
            renderer = model_renderer(workspace, solution, sfm, survey, backend=options.backend, progress=progress)
            self.model = MeasuringModel(workspace, survey, renderer, options)
            task.advance()
        self.solution, self.sparse, self.frame = solution, renderer.sparse, frame_of(solution, sfm)
        self.photographs, self.survey = Photographs(workspace, survey, self.sparse), survey
        grid = None if self.model.posterior is None else self.model.posterior.grid
        self._painter = Painter(renderer, self.photographs, self.frame, grid)
        self._hash, self.jobs, self._lock = hash_file(workspace.path(MODEL), {}), Jobs(), threading.RLock()
        folder = workspace.root / FOLDER
        self.saved = SavedMeasurements(folder)
        self.marks = KeptMarks(
            folder, points_to_mark(survey, self._xyz_of), self.model.target.crs.lla_from_xyz,
            self.model.target.crs.xyz_from_lla,
        )  # fmt: skip
        self._surveyed = {p.name: p for p in (*survey.control_points, *survey.check_points)}
        self._scene = described_scene(workspace, self.model, self.frame)
        # The Gaussians are sorted now, so that the first click does not wait.
        self._ended = threading.Event()
        self._sorting = threading.Thread(target=self._prepare, args=(renderer,))
        self._sorting.start()

    def _prepare(self, renderer: ModelRenderer) -> None:
        renderer.blocks  # noqa: B018
        self._painter.prepare_motion(self._ended)

    def close(self) -> None:
        self.jobs.close()
        self._ended.set()
        self._sorting.join()  # torch ends the whole process where Python's end takes a thread away from it

    # What is seen

    def picture(self, request: requests.PictureRequest) -> PageView:
        """Return a picture; an InputError: there is no such photograph, or it cannot be read."""
        if request.photograph is not None:
            self._known(request.photograph)
        return self._painter.paint(request.camera(), request.wanted())

    def scene(self) -> Json:
        """Return all that a page needs once: frame, cameras, points, outlines, what may be measured."""
        return self._scene

    def photograph(self, camera: int, part: tuple[float, float, float] | None, longest_px: int) -> bytes:
        """Return a photograph as JPEG, whole or a square around a pixel: x, y, half a side."""
        self._known(camera)
        image = self.photographs.full(camera)
        if part is not None:
            x, y, half = part
            matrix = np.array([[1.0, 0.0, x - half - 0.5], [0.0, 1.0, y - half - 0.5]])
            side = max(int(2 * half), 1)
            image = np.asarray(cv2.warpAffine(image, matrix, (side, side), flags=cv2.WARP_INVERSE_MAP), np.uint8)
        return jpeg_of(limited(image, longest_px), 88)

    def seen_by(self, request: requests.SeenRequest) -> list[Json]:
        """Return the photographs that see a place, the best first: fine pixels, and away from their rim."""
        place, photographs = request.position(), []
        centers = self.solution.center_in_geo
        for camera, pixel in appears_in(place, self.solution, self.sparse):
            lens, away = self.sparse.camera_of(camera), centers[camera] - place
            size, away_m = np.array([lens.width, lens.height]), float(np.linalg.norm(away))
            gsd_m = away_m / lens.mean_focal_px
            rim = float(np.min(np.minimum(pixel, size - pixel) / size))
            down_deg = float(np.degrees(np.arccos(np.clip(away[2] / away_m, -1, 1))))
            described = {"camera": camera, "image": self.name_of(camera), "px": pixel.tolist(), "gsd_m": gsd_m}
            photographs.append(
                (gsd_m * (2.0 if rim < _PIXEL_MARGIN else 1.0), {**described, "angle_deg": down_deg})
            )
        return [each for _, each in sorted(photographs, key=lambda each: each[0])[:_MOST_SEEN]]

    def name_of(self, camera: int) -> str:
        return self.sparse.image_name[camera]

    def _known(self, camera: int) -> None:
        if camera >= len(self.sparse.image_name):
            raise InputError(
                "no-such-photograph", f"There is no photograph {camera}.", remedy="Load the page again."
            )

    # Measuring

    def pick(self, request: requests.PickRequest) -> Json:
        """Return the surface under a pixel of a page, with the σ of pointing at it, or why there is none."""
        point = self.model.reader.under(self.frame.sight(request.camera(), request.x, request.y))
        if isinstance(point, SurfacePoint):
            cov = pointing_covariance(self.model.reader, self.frame, request.camera(), (request.x, request.y))
            point = replace(point, cov_of_surface=point.cov_of_surface + cov)
        return self._measured(point)

    def surveyed(self, name: str) -> Json:
        """Return a surveyed point as its marks show it on the rendered surface, with its surveyed place."""
        point = self._surveyed.get(name)
        if point is None:
            raise InputError(
                "no-such-point", f"There is no surveyed point {name!r}.", remedy="Load the page again."
            )
        rays = mark_rays((point,), self.sparse)
        measured = self._measured(self.model.reader.behind_marks(rays))
        return {
            **measured,
            "surveyed": self.model.target.xyz_from_geo(np.array([point.position_in_geo]))[0].tolist(),
        }

    def marked(self, name: str) -> Json:
        """Return a marked point, triangulated."""
        rays = rays_of(self._point(name), self.sparse)
        place, cov = self.model.triangulated(rays)
        if not np.isfinite(place).all():
            return {"reason": f"{name} has fewer than two marks"}
        return self._measured(SurfacePoint(place, np.zeros((3, 3)) if cov is None else cov, rays.camera))

    def _measured(self, point: SurfacePoint | NoSurface) -> Json:
        if isinstance(point, NoSurface):
            return {"reason": point.reason}
        xyz, sigma_m = self.model.coordinates(point)
        return {
            "point": {
                "position_in_geo": point.position_in_geo.tolist(),
                "cov_of_surface": point.cov_of_surface.tolist(),
                "cameras": [int(camera) for camera in point.cameras],
            },
            "xyz": xyz.tolist(),
            "sigma_m": None if sigma_m is None else sigma_m.tolist(),
        }

    def measure(self, request: requests.MeasureRequest) -> ViewJob:
        """Begin a measurement; its answer has quantities, and of a profile the heights."""
        for camera in {camera for place in request.points for camera in place.cameras}:
            self._known(camera)
        return self.jobs.begin(request, lambda job: self._answers(job, request))

    def _answers(self, job: ViewJob, request: requests.MeasureRequest) -> Iterator[Json]:
        points, kind = [place.point() for place in request.points], request.kind
        if kind == "point":
            yield {"quantities": []}
        elif kind in ("distance", "polyline"):
            joint = self.model.jointly(points)
            yield _answer(distances(joint) if kind == "distance" else length(joint))
        else:
            for fineness in (
                Fineness(ESTIMATE.places, ESTIMATE.views, lambda share: job.advance(0.25 * share)),
                Fineness(advance=lambda share: job.advance(0.25 + 0.75 * share)),
            ):
                if kind == "area":
                    yield _answer(self.model.area(points, fineness))
                elif kind == "volume":
                    yield _answer(self.model.volume(points, request.base, fineness))
                else:
                    joint, line = self.model.jointly(points), self.model.profile(points, fineness)
                    yield {**_answer(length(joint)), "profile": profile_json(line)}

    def save(self, request: requests.SaveRequest) -> list[Json]:
        """Save the measurement of a finished job; return all. A GeorefError: it was not saved, and why."""
        job = self.jobs.find(request.job)
        if job is None or job.state != "done" or not isinstance(job.request, requests.MeasureRequest):
            raise InputError(
                "measurement-unfinished", "The measurement is not finished.", remedy="Measure it again, then save."
            )
        quantities = tuple(Quantity(**each) for each in job.answer["quantities"])
        with self._lock:
            self.saved.put(
                NamedMeasurement(
                    id=new_id(),
                    name=request.name.strip() or job.request.kind,
                    kind=job.request.kind,
                    crs=self.model.target.crs.name,
                    model=self._hash,
                    points=tuple(self._saved_point(place.point()) for place in job.request.points),
                    quantities=quantities,
                )
            )
        return self.measurements()

    def _saved_point(self, point: SurfacePoint) -> SavedPoint:
        xyz, sigma_m = self.model.coordinates(point)
        origin = self.survey.origin
        lla = None if origin is None else lla_from_enu(point.position_in_geo[None], origin)[0].tolist()
        return SavedPoint.model_validate(
            {
                "position_in_geo": point.position_in_geo.tolist(),
                "cov_of_surface": [tuple(map(float, row)) for row in point.cov_of_surface],
                "images": [self.name_of(int(camera)) for camera in point.cameras],
                "xyz": xyz.tolist(),
                "sigma_m": None if sigma_m is None else sigma_m.tolist(),
                "lla": lla,
            }
        )

    def measurements(self) -> list[Json]:
        """Return the saved measurements, also those of other viewers."""
        number = {name: camera for camera, name in enumerate(self.sparse.image_name)}
        with self._lock:
            self.saved.read()
            return [
                {
                    **each.model_dump(mode="json"),
                    "older": each.model != self._hash,
                    "cameras": [[number[name] for name in point.images if name in number] for point in each.points],
                }
                for each in self.saved.all
            ]

    def rename(self, identity: str, request: requests.NamedRequest) -> list[Json]:
        with self._lock:
            self.saved.put(self._saved(identity).model_copy(update={"name": request.name}))
        return self.measurements()

    def remove(self, identity: str) -> list[Json]:
        with self._lock:
            self.saved.remove(self._saved(identity))
        return self.measurements()

    def put_back(self, measurement: NamedMeasurement) -> list[Json]:
        """Save a measurement again that was removed."""
        with self._lock:
            self.saved.put(measurement)
        return self.measurements()

    def saved_file(self, name: str) -> bytes:
        """Return a file of saved measurements; an InputError: there is none."""
        path = self._workspace.root / FOLDER / name
        if not path.is_file():
            raise InputError("nothing-saved", f"There is no {name} yet.", remedy="Save a measurement first.")
        return path.read_bytes()

    def _saved(self, identity: str) -> NamedMeasurement:
        measurement = next((each for each in self.saved.all if each.id == identity), None)
        if measurement is None:
            raise InputError(
                "no-such-measurement", "The measurement was removed meanwhile.", remedy="Load the page again."
            )
        return measurement

    # Marking

    def _xyz_of(self, points: tuple[SurveyedPoint, ...]) -> FloatArray:
        position = np.array([point.position_in_geo for point in points]).reshape(-1, 3)
        return self.model.target.xyz_from_geo(position) if len(position) else position

    def points(self) -> Json:
        """Return all points with their marks, residuals, and which marks disagree with the others."""
        with self._lock:
            self.marks.read()
            points = self.marks.points
        wrong = {
            (mark.point, mark.image): mark.off_px
            for mark in wrong_marks([surveyed_marks(point) for point in points], self.sparse)
        }
        return {
            "is_written": self.marks.is_written,
            "points": [self._described_point(point, wrong) for point in points],
        }

    def _described_point(self, point: MarkedPoint, wrong: dict[tuple[str, str], float]) -> Json:
        good = MarkedPoint(point.name, point.xyz, point.is_check, {
            image: place for image, place in point.marks.items() if (point.name, image) not in wrong
        })  # fmt: skip
        place, cov = self.model.triangulated(rays_of(good, self.sparse))
        rays, off = rays_of(point, self.sparse), {}
        if np.isfinite(place).all():
            errors = residuals_px(place, rays, self.solution)
            off = {
                self.name_of(int(camera)): float(error) for camera, error in zip(rays.camera, errors, strict=True)
            }
        expected = self.expected(good)
        return {
            "name": point.name,
            "xyz": point.xyz,
            "is_check": point.is_check,
            "own": point.name not in self._surveyed,
            "place_in_geo": None if expected is None else expected.tolist(),
            "triangulated": self.model.target.xyz_from_geo(place[None])[0].tolist() if off else None,
            "sigma_m": None if cov is None or not off else np.sqrt(np.diag(cov)).tolist(),
            "marks": [
                {
                    "image": image,
                    "px": place_px,
                    "residual_px": wrong.get((point.name, image), off.get(image)),
                    "wrong": (point.name, image) in wrong,
                }
                for image, place_px in point.marks.items()
            ],
        }

    def expected(self, point: MarkedPoint) -> FloatArray | None:
        """Return where a point must be (3,) in `geo`: by its marks, or by its survey; None: neither tells."""
        by_marks, _ = self.model.triangulated(rays_of(point, self.sparse))
        if np.isfinite(by_marks).all():
            return by_marks
        if point.xyz is None:
            return None
        return np.asarray(self.model.target.geo_from_xyz(np.array([point.xyz]))[0])

    def _point(self, name: str) -> MarkedPoint:
        point = next((point for point in self.marks.points if point.name == name), None)
        if point is None:
            raise InputError(
                "no-such-point", f"There is no point {name!r} any more.", remedy="Load the page again."
            )
        return point

    def in_photographs(self, name: str) -> list[Json]:
        """Return the photographs that must show a point, the nearest first; all, where nothing tells its place."""
        point = self._point(name)
        place = self.expected(point)
        if place is None:
            views: list[tuple[int, Any]] = [(camera, None) for camera in range(len(self.sparse.image_name))]
        else:
            views = [(camera, pixel.tolist()) for camera, pixel in appears_in(place, self.solution, self.sparse)]
        return [
            {
                "camera": camera,
                "image": self.name_of(camera),
                "px": pixel,
                "mark": point.marks.get(self.name_of(camera)),
                "size": [self.sparse.camera_of(camera).width, self.sparse.camera_of(camera).height],
            }
            for camera, pixel in views
        ]

    def lines(self, name: str, camera: int) -> list[Json]:
        """Return the epipolar lines of a point's marks in a photograph."""
        self._known(camera)
        point = self._point(name)
        lines = epipolar_lines(self.solution, self.sparse, point, camera, self.expected(point))
        return [{"image": image, "px": np.round(line, 2).tolist()} for image, line in lines]

    def set_mark(self, request: requests.MarkRequest) -> Json:
        """Set or remove a mark; an InputError: it is outside its photograph."""
        names = self.sparse.image_name
        if request.place_px is not None:
            if request.image not in names:
                raise InputError(
                    "no-such-photograph",
                    f"The model has no photograph {request.image}.",
                    remedy="Load the page again.",
                )
            lens = self.sparse.camera_of(names.index(request.image))
            x, y = request.place_px
            if not (0 <= x <= lens.width and 0 <= y <= lens.height):
                raise InputError("mark-outside", "This place is outside the photograph.")
        with self._lock:
            self.marks.set_mark(request.point, request.image, request.place_px)
        return self.points()

    def set_point(self, request: requests.PointRequest) -> Json:
        with self._lock:
            self.marks.set_point(request.name.strip(), request.xyz, is_check=request.is_check)
        return self.points()

    def remove_point(self, request: requests.NamedRequest) -> Json:
        with self._lock:
            self.marks.remove_point(request.name)
        return self.points()

    def write_marks(self) -> Json:
        """Write the files for `--gcp` and `--checkpoints`."""
        with self._lock:
            files = self.marks.write(self.model.target.crs.name)
        if not files:
            raise InputError("nothing-to-write", "No point has both coordinates and marks: nothing to write.")
        return {"files": [str(file) for file in files], "heights": self.model.target.crs.vertical.described}

    def propose(self, request: requests.ProposalRequest) -> ViewJob:
        """Begin the search for marks of a point in further photographs."""
        point = self._point(request.point)

        def work(job: ViewJob) -> Iterator[list[Json]]:
            place = self.expected(point)
            if place is None or not point.marks:
                raise InputError(
                    "no-marks", f"{point.name} needs a mark, and its coordinates or a second mark, first."
                )
            answers: list[Json] = []
            yield answers
            for each in proposals(
                self.solution, self.sparse, point, place, self.photographs.full, advance=job.advance
            ):
                answers = [*answers, asdict(each)]
                yield answers

        return self.jobs.begin(request, work)


def _answer(quantities: tuple[Quantity, ...]) -> Json:
    return {"quantities": [asdict(each) for each in quantities]}


def profile_json(line: Profile) -> Json:
    """Return a profile for the page: distances along it and heights with σ, null where none is measured."""

    def listed(values: FloatArray) -> list[float | None]:
        return [None if not np.isfinite(value) else round(float(value), 5) for value in values]

    return {
        "along_m": np.round(line.along_m, 4).tolist(),
        "height": listed(line.height),
        "sigma_m": listed(line.sigma_m),
        "xy": line.xy.tolist(),
    }


def jpeg_of(rgb: ByteArray, quality: int) -> bytes:
    """Return a picture (H, W, 3) of bytes, red first, as JPEG of a quality from 0 to 100."""
    _, encoded = cv2.imencode(".jpg", np.ascontiguousarray(rgb[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, quality])
    return encoded.tobytes()


def model_stamp(workspace: Workspace) -> tuple[int, ...]:
    """Return what changes when the model is trained again; a MissingProductError: there is no trained model."""
    return tuple(workspace.path(product).stat().st_mtime_ns for product in (MODEL, GAUSSIANS))
