"""Stage `export-mesh`: the surface of the trained model as a triangle mesh with the colours of the photographs.

Reads the trained model, the survey and the photographs. Writes `mesh/mesh.ply` with coloured vertices,
`mesh/mesh.glb` with a texture, on request `mesh.obj` and, in a CRS, `mesh_crs.ply`; a sidecar beside each.
"""

from pathlib import Path

import numpy as np

from pipelines.core.errors import DegenerateGeometryError, ResourceError
from pipelines.core.machine import free_main_memory_bytes
from pipelines.core.stages import MESH, MESH_GLB
from pipelines.core.types import BoolArray, ByteArray, FloatArray
from pipelines.core.workspace import StageRun, Summary
from pipelines.deliver.options import ExportMeshOptions
from pipelines.deliver.placement import place
from pipelines.deliver.surface import surface_views
from pipelines.formats.georef_sidecar import MeshCrsSidecar, MeshFigures, MeshSidecar, write_sidecar
from pipelines.formats.mesh_files import write_mesh_glb, write_mesh_obj, write_mesh_ply
from pipelines.surface.fusion import COARSEST, pixel_on_surface_m
from pipelines.surface.mesh import closed, surface_mesh, vertex_normals, without_islands
from pipelines.surface.texture import TexturedMesh, colours_of, textured
from pipelines.surface.tsdf import GridSettings, RawMesh, occupied_cells
from pipelines.survey.area import area_of
from pipelines.survey.headline import headline_of
from pipelines.survey.target_crs import target_crs
from pipelines.survey.trained_survey import load_trained

_BASE_VOXELS = 4.0  # of the base of a watertight mesh, below its lowest vertex
# Measured on a simulated flight: the mesh with its texture, its parts and the copies that welding makes.
_FIXED_BYTES, _CELL_BYTES = 850 << 20, 600


def run(stage: StageRun, options: ExportMeshOptions) -> Summary:
    """Write the files and return their figures.

    Raises:
        DegenerateGeometryError: the views agree nowhere.
        ResourceError: the mesh does not fit into the memory.
        BackendUnavailableError: a library of the extra is missing.
    """
    trained, progress = load_trained(stage.workspace), stage.progress
    headline, folder = headline_of(stage.workspace), stage.out
    placement = place(trained.model, trained.survey, trained.gaussians.means.numpy(), headline)
    frame_from_model, geo_from_file = placement.file_from_model, placement.file_from_geo.inverse()
    target = None
    if options.crs is not None:
        middle = geo_from_file.apply(np.zeros((1, 3)))
        target = target_crs(options, trained.survey.origin, middle, trained.survey.vertical)
    views = surface_views(stage, trained)
    pixel_m = pixel_on_surface_m(views, trained.geo_from_model)
    voxel_m = options.voxel or pixel_m
    error_m = voxel_m / 2 if options.simplify_error is None else options.simplify_error
    settings = GridSettings(voxel_m, pixel_m, COARSEST * pixel_m, options.min_views)
    area = area_of(options, trained)

    def inside(place_in_file: FloatArray) -> BoolArray:
        return area.contains(geo_from_file.apply(place_in_file))

    cells = occupied_cells(views, frame_from_model, settings, inside, progress)
    _require_memory(len(cells), voxel_m)
    simple = surface_mesh(
        views, frame_from_model, settings, cells, error_m=error_m, inside=inside, progress=progress
    )
    if not len(simple.mesh.faces):
        raise DegenerateGeometryError(
            "no-surface-points",
            f"No part of the surface has the same depth in {options.min_views} training views: too few "
            "photographs overlap, or the training was too short. Add photographs, train longer, or "
            "lower --min-views.",
        )
    mesh, islands = without_islands(simple.mesh, options.least_part)
    surface_faces = len(mesh.faces)
    if options.watertight:
        mesh, surface_faces = closed(mesh, _BASE_VOXELS * voxel_m)
    rgb, _ = colours_of(mesh.vertices, vertex_normals(mesh), views, frame_from_model)
    texel_m = max(voxel_m, pixel_m)
    shown = textured(mesh, views, frame_from_model, texel_m, progress, surface_faces=surface_faces)
    views.close()
    figures = MeshFigures(
        voxel_m=voxel_m,
        texel_m=shown.texel_m,
        faces_before_simplification=simple.faces_before,
        faces=len(mesh.faces),
        rms_simplification_error_m=simple.rms_error_m,
        largest_simplification_error_m=simple.largest_error_m,
        watertight=options.watertight,
    )
    sidecar = MeshSidecar(**dict(placement.sidecar()), mesh=figures)
    _write_in_frame(folder, mesh, rgb, shown, sidecar, obj=options.obj)
    if target is not None:
        xyz, path = target.xyz_from_geo(geo_from_file.apply(mesh.vertices)), folder / "mesh_crs.ply"
        write_mesh_ply(path, xyz, mesh.faces, rgb, double=True)
        bounds = [xyz.min(axis=0), xyz.max(axis=0)]
        in_crs = target.sidecar(bounds, headline, None, placement.cautions)
        write_sidecar(MeshCrsSidecar(**dict(in_crs), mesh=figures), path)
    values = {
        **figures.model_dump(),
        "vertices": len(mesh.vertices),
        "area_ha": area.hectares,
        "islands_left_out": islands,
        "texture_px": len(shown.image),
        "crs": None if target is None else target.crs.name,
    }
    key = (
        f"{len(mesh.faces)} faces of {simple.faces_before}, voxels of {voxel_m:.3f} m, simplified by "
        f"{simple.rms_error_m:.3f} m RMS, {simple.largest_error_m:.3f} m at most"
    )
    return Summary(key, values, cautions=placement.cautions)


def _write_in_frame(
    folder: Path, mesh: RawMesh, rgb: ByteArray, shown: TexturedMesh, sidecar: MeshSidecar, *, obj: bool
) -> None:
    """Write the files in the frame of the sidecar, which comes beside each."""
    files = [folder / Path(MESH).name, folder / Path(MESH_GLB).name]
    write_mesh_ply(files[0], mesh.vertices, mesh.faces, rgb, double=False)
    with_texture = (shown.mesh.vertices, shown.mesh.faces, shown.uv, shown.image)
    write_mesh_glb(files[1], *with_texture, extras={"georef": sidecar.model_dump(mode="json", by_alias=True)})
    if obj:
        files.append(folder / "mesh.obj")
        write_mesh_obj(files[2], *with_texture)
    for path in files:
        write_sidecar(sidecar, path)


def _require_memory(cells: int, voxel_m: float) -> None:
    """Refuse a mesh that the memory would not hold, by the number of cells with surface."""
    needed, free = _FIXED_BYTES + _CELL_BYTES * cells, free_main_memory_bytes()
    if needed > free:
        raise ResourceError(
            "mesh-memory",
            f"The mesh with voxels of {voxel_m:.3f} m may need {needed / 2**30:.1f} GiB of memory; "
            f"{free / 2**30:.1f} GiB are free. Give a larger --voxel.",
        )
