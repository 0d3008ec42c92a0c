"""Stage `export-mesh`: the surface of the trained model as a triangle mesh with the colours of the photographs.

Reads the trained model, the survey and the photographs. Writes `mesh/mesh.ply` with coloured
vertices and their σ, `mesh/mesh.glb`, simplified, with a texture, on request `mesh.obj` and, in a CRS,
`mesh_crs.ply`; a sidecar beside each.
"""

import logging
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pipelines.adjust.accuracy_grid import AccuracyGrid
from pipelines.core.errors import DegenerateGeometryError, ResourceError
from pipelines.core.extras import require
from pipelines.core.machine import free_main_memory_bytes
from pipelines.core.products import union
from pipelines.core.progress import Progress
from pipelines.core.stages import MESH, MESH_GLB
from pipelines.core.types import ByteArray, FloatArray, joined_rows, rows_of, vector3
from pipelines.core.workspace import StageRun, Summary
from pipelines.deliver.options import ExportMeshOptions
from pipelines.deliver.placement import solved_placement
from pipelines.deliver.surface import predicted_sigma, shared_squares, surface_views, without_sigma
from pipelines.formats.georef_sidecar import MeshCrsSidecar, MeshFigures, MeshHole, MeshSidecar, write_sidecar
from pipelines.formats.mesh_files import write_mesh_glb, write_mesh_obj, write_mesh_ply
from pipelines.geometry.similarity import Similarity
from pipelines.surface.fusion import fusion_settings, pixel_on_surface_m
from pipelines.surface.measured_area import area_of
from pipelines.surface.mesh import (
    Hole,
    RawMesh,
    closed,
    compact,
    distances_from_mesh,
    holes_of,
    open_share,
    vertex_normals,
    without_islands,
)
from pipelines.surface.poisson import MeasuredPoints, closed_gap_m, poisson_mesh, simplified, surface_sigma_at
from pipelines.surface.surface_views import SurfaceViews, model_renderer
from pipelines.surface.texture import TexturedMesh, photographed_colours, textured
from pipelines.survey.area import Area
from pipelines.survey.headline import headline_of
from pipelines.survey.navigation import load_survey
from pipelines.survey.solution import read_sfm, read_trained
from pipelines.survey.target_crs import target_crs

_BASE_VOXELS = 4.0  # of the base of a watertight mesh, below its lowest vertex
_AROUND = 16.0  # spacings around the area: points there hold the surface at its rim
_PART_M2, _PART_VOXELS = 4.0, 100.0  # least area of an unconnected part: fewer voxels show no form
_SAMPLE = 200_000  # vertices at most that are measured against the simplified mesh
_LISTED = 100  # widest holes
_LEAST_POINTS = 100
# Estimated, not measured: the solver, the mesh with its texture, and the copies that are made of them.
_FIXED_BYTES, _POINT_BYTES = 850 << 20, 2000
log = logging.getLogger(__name__)
SIGMA_COUNTS = "georeference, disagreement of the training views about the surface, distance from measured points"


def run(stage: StageRun, options: ExportMeshOptions) -> Summary:
    """Write the files and return their figures.

    Raises:
        DegenerateGeometryError: the views agree nowhere.
        ResourceError: the mesh does not fit into the memory.
        BackendUnavailableError: a library of the extra is missing.
    """
    require("mesh")
    model = read_trained(stage.workspace)
    sfm, survey = read_sfm(stage.workspace, model), model.weighted(load_survey(stage.workspace))
    headline, folder, progress = headline_of(stage.workspace), stage.out, stage.progress
    renderer = model_renderer(stage.workspace, model, sfm, survey, progress=progress)
    placement = solved_placement(model, survey, renderer.gaussians.means.numpy(), headline)
    geo_from_file = placement.file_from_geo.inverse()
    target = None
    if options.crs is not None:
        middle = geo_from_file.apply(np.zeros((1, 3)))
        target = target_crs(options, survey.origin, middle, survey.vertical)
    views = surface_views(stage, renderer)
    pixel_m = pixel_on_surface_m(views, model.similarity)
    area = area_of(options, stage.workspace, model, sfm, survey, progress=progress)
    points = _points(views, model.similarity, area, placement.file_from_geo, options=options, progress=progress)
    base_m = _BASE_VOXELS * points.spacing_m if options.watertight else None
    # COLMAP solves and simplifies on one core: the other does meanwhile what needs no result of these.
    with ThreadPoolExecutor(1) as beside:
        predicted = beside.submit(predicted_sigma, stage.workspace, model, sfm)
        beside.submit(lambda: points.tree)
        whole, islands = _whole(points, area, geo_from_file, options=options, folder=folder, progress=progress)
        grid, no_sigma = predicted.result()
        described = beside.submit(
            _described, whole, points, grid, geo_from_file,
            views=views, file_from_model=placement.file_from_model, base_m=base_m,
        )  # fmt: skip
        holes = beside.submit(holes_of, whole)
        simple, errors = _simplified(
            whole, points.spacing_m, beside, options=options, folder=folder, progress=progress
        )
        written, sigma, rgb = described.result()
        covered, surface_faces = (simple, len(simple.faces)) if base_m is None else closed(simple, base_m)
        texel_m = max(points.spacing_m, pixel_m)
        mesh_with_texture = textured(
            covered, views, placement.file_from_model, texel_m, progress, surface_faces=surface_faces
        )
        surface = _Surface(whole, simple, *errors.result(), islands, holes.result())
    whole, simple = written, covered
    views.close()
    cautions = union(placement.cautions, without_sigma("The mesh states no σ of its vertices", no_sigma))
    exact = replace(surface, rms_error_m=0.0, largest_error_m=0.0)
    of_whole, figures = (
        of_file.figures(mesh, points.spacing_m, mesh_with_texture.texel_m, watertight=options.watertight)
        for of_file, mesh in ((exact, whole), (surface, simple))
    )
    in_frame = {**dict(placement.sidecar()), "cautions": cautions}
    write_mesh_ply(folder / Path(MESH).name, whole.vertices, whole.faces, rgb, double=False, sigma=sigma)
    write_sidecar(MeshSidecar(**in_frame, mesh=of_whole), folder / Path(MESH).name)
    _write_textured(folder, mesh_with_texture, MeshSidecar(**in_frame, mesh=figures), obj=options.obj)
    if target is not None:
        xyz, path = target.xyz_from_geo(geo_from_file.apply(whole.vertices)), folder / "mesh_crs.ply"
        write_mesh_ply(path, xyz, whole.faces, rgb, double=True, sigma=sigma)
        bounds = [xyz.min(axis=0), xyz.max(axis=0)]
        in_crs = target.sidecar(bounds, headline, None, cautions)
        write_sidecar(MeshCrsSidecar(**dict(in_crs), mesh=of_whole), path)
    values = {
        **figures.model_dump(exclude={"widest_holes"}),
        "vertices": len(simple.vertices),
        "area_ha": area.hectares,
        "islands_left_out": surface.islands,
        "texture_px": len(mesh_with_texture.image),
        "crs": None if target is None else target.crs.name,
    }
    key = (
        f"{len(simple.faces)} faces of {len(whole.faces)}, voxels of {points.spacing_m:.3f} m, simplified by "
        f"{surface.rms_error_m:.3f} m RMS, {surface.largest_error_m:.3f} m at most; {surface.holes_text}"
    )
    return Summary(key, values, cautions=cautions)


def _points(
    views: SurfaceViews,
    geo_from_model: Similarity,
    area: Area,
    file_from_geo: Similarity,
    *,
    options: ExportMeshOptions,
    progress: Progress,
) -> MeasuredPoints:
    """Return the fused points in and around the area, in the frame of the file; errors as of `run`."""
    spacing_m = options.voxel
    while True:
        settings = fusion_settings(views, geo_from_model, options.min_views, spacing_m)
        around = replace(area, polygon=area.polygon.buffer(_AROUND * settings.spacing_m))
        parts = []
        for square in shared_squares(views, geo_from_model, settings, progress):
            # Points whose normals cancel say nothing of the side.
            with_side = np.isfinite(square.normal).all(axis=1)
            parts.append(rows_of(square, np.flatnonzero(around.contains(square.position) & with_side)))
        if sum(len(part.position) for part in parts) < _LEAST_POINTS:
            raise _no_surface(options)
        cloud = joined_rows(parts)
        excess = _memory_excess(len(cloud.position), settings.spacing_m, stated=options.voxel is not None)
        if excess <= 1:
            break
        # Points on a surface become fewer with the square of their distance.
        spacing_m = 1.1 * excess**0.5 * settings.spacing_m
        log.warning(
            "Voxels of %.3f m would need %.1f times the free memory: the mesh has voxels of %.3f m (--voxel).",
            settings.spacing_m,
            excess,
            spacing_m,
        )
    position, normal = file_from_geo.apply(cloud.position), cloud.normal @ file_from_geo.rotation.T
    return MeasuredPoints(position, normal, cloud.sigma_m, settings.spacing_m)


def _no_surface(options: ExportMeshOptions) -> DegenerateGeometryError:
    return DegenerateGeometryError(
        "no-surface-points",
        (
            f"No part of the surface has the same depth in {options.min_views} training views: too few "
            "photographs overlap, or the training was too short."
        ),
        remedy="Add photographs, train longer, or lower --min-views.",
    )


@dataclass(frozen=True)
class _Surface:
    """Mesh of the surface, whole and simplified, and what was found of it."""

    whole: RawMesh
    simple: RawMesh
    rms_error_m: float
    largest_error_m: float
    islands: int
    holes: list[Hole]

    def figures(self, mesh: RawMesh, voxel_m: float, texel_m: float, *, watertight: bool) -> MeshFigures:
        """Return the figures of a mesh that is written: the whole or the simplified, or either closed."""
        listed = self.holes[:_LISTED]
        return MeshFigures(
            voxel_m=voxel_m,
            texel_m=texel_m,
            faces_before_simplification=len(self.whole.faces),
            faces=len(mesh.faces),
            rms_simplification_error_m=self.rms_error_m,
            largest_simplification_error_m=self.largest_error_m,
            closed_gap_m=closed_gap_m(voxel_m),
            open_edges=open_share(mesh),
            holes=0 if watertight else len(self.holes),
            widest_holes=tuple(
                MeshHole(at=vector3(hole.middle), width_m=hole.width_m) for hole in listed if not watertight
            ),
            watertight=watertight,
        )

    @property
    def holes_text(self) -> str:
        if not self.holes:
            return "no holes"
        return f"{len(self.holes)} holes, the widest of {self.holes[0].width_m:.1f} m"


def _whole(
    points: MeasuredPoints,
    area: Area,
    geo_from_file: Similarity,
    *,
    options: ExportMeshOptions,
    folder: Path,
    progress: Progress,
) -> tuple[RawMesh, int]:
    """Return the mesh of the surface in the area, and the number of islands left out; errors as of `run`."""
    voxel_m = points.spacing_m
    whole = poisson_mesh(points, voxel_m, folder, progress)
    inside = area.contains(geo_from_file.apply(whole.vertices))
    whole = compact(RawMesh(whole.vertices, whole.faces[inside[whole.faces].all(axis=1)]))
    if not len(whole.faces):
        raise _no_surface(options)
    least_m2 = max(_PART_M2, _PART_VOXELS * voxel_m**2) if options.least_part is None else options.least_part
    return without_islands(whole, least_m2)


def _described(
    whole: RawMesh,
    points: MeasuredPoints,
    grid: AccuracyGrid | None,
    geo_from_file: Similarity,
    *,
    views: SurfaceViews,
    file_from_model: Similarity,
    base_m: float | None,
) -> tuple[RawMesh, tuple[FloatArray, FloatArray], ByteArray]:
    """Return the whole mesh, closed where a base is asked for, with σ and colours (V, 3) of its vertices."""
    if base_m is not None:
        whole, _ = closed(whole, base_m)
    normals = vertex_normals(whole)
    sigma = _sigma(whole.vertices, normals, points, grid, geo_from_file)
    rgb, _ = photographed_colours(whole.vertices, normals, views, file_from_model)
    return whole, sigma, rgb


def _simplified(
    whole: RawMesh,
    voxel_m: float,
    beside: Executor,
    *,
    options: ExportMeshOptions,
    folder: Path,
    progress: Progress,
) -> tuple[RawMesh, Future[tuple[float, float]]]:
    """Return a mesh simplified, and to come, the RMS and the largest distance of it; errors as of `run`."""
    error_m = voxel_m / 2 if options.simplify_error is None else options.simplify_error
    simple = simplified(whole, error_m, folder, progress)

    def errors() -> tuple[float, float]:
        drawn = whole.vertices[:: -(-len(whole.vertices) // _SAMPLE)]
        distances = distances_from_mesh(drawn, simple, voxel_m) if error_m > 0 else np.zeros(1)
        return float(np.sqrt(np.mean(distances**2))), float(distances.max())

    return simple, beside.submit(errors)


def _sigma(
    vertices: FloatArray,
    normals: FloatArray,
    points: MeasuredPoints,
    grid: AccuracyGrid | None,
    geo_from_file: Similarity,
) -> tuple[FloatArray, FloatArray]:
    """Return the horizontal and vertical σ (V,) of the vertices in metres, as of the cloud; NaN: unknown."""
    if grid is None:
        unknown = np.full(len(vertices), np.nan)
        return unknown, unknown
    along = surface_sigma_at(vertices, points)[:, None] * (normals @ geo_from_file.rotation.T)
    georeference = np.einsum("vii->vi", grid.cov_at(geo_from_file.apply(vertices)))
    east, north, up = (georeference + along**2).T
    return np.sqrt(east + north), np.sqrt(up)


def _write_textured(folder: Path, shown: TexturedMesh, sidecar: MeshSidecar, *, obj: bool) -> None:
    """Write the files with a texture, in the frame of the sidecar, which comes beside each."""
    files = [folder / Path(MESH_GLB).name]
    with_texture = (shown.mesh.vertices, shown.mesh.faces, shown.uv, shown.image)
    write_mesh_glb(files[0], *with_texture, extras={"georef": sidecar.model_dump(mode="json", by_alias=True)})
    if obj:
        files.append(folder / "mesh.obj")
        write_mesh_obj(files[1], *with_texture)
    for path in files:
        write_sidecar(sidecar, path)


def _memory_excess(points: int, voxel_m: float, *, stated: bool) -> float:
    """Return the share of the free memory that a mesh of so many points may need; its fixed part is left out.

    Raises:
        ResourceError: it is more than one, and the voxels are `stated`; or the fixed part alone is more.
    """
    needed, free = _FIXED_BYTES + _POINT_BYTES * points, free_main_memory_bytes()
    if needed > free and (stated or free < _FIXED_BYTES):
        raise ResourceError(
            "mesh-memory",
            (
                f"The mesh with voxels of {voxel_m:.3f} m may need {needed / 2**30:.1f} GiB of memory; "
                f"{free / 2**30:.1f} GiB are free."
            ),
            remedy="Give a larger --voxel.",
        )
    return _POINT_BYTES * points / max(free - _FIXED_BYTES, 1)
