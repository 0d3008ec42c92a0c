"""What each file of a workspace is for, in the words of those who take it away."""

from __future__ import annotations

# By workspace path; a path without a suffix is a folder. In the order in which people look for them.
PURPOSES: dict[str, str] = {
    "export/splat.ply": "the splat as trained, to look at and to edit (SuperSplat, Blender)",
    "measurable/splat.measurable.ply": "the splat to measure in, for viewers that pick centres; many times larger",
    "raster/orthophoto.tif": "orthophoto, for GIS and CAD",
    "raster/dsm.tif": "surface model, for volumes, profiles and GIS",
    "raster/sigma_h.tif": "horizontal σ of each cell",
    "raster/sigma_v.tif": "vertical σ of each cell",
    "raster/contours.gpkg": "contour lines, for GIS",
    "raster/contours.dxf": "contour lines, for CAD",
    "raster/hillshade.png": "picture of the surface model",
    "raster/preview.png": "picture of the orthophoto",
    "cloud/cloud.laz": "point cloud with σ, for surveying software (CloudCompare, QGIS, PDAL)",
    "cloud/cloud.ply": "the same point cloud, for viewers without LAZ",
    "spz/splat.spz": "the splat compressed, for viewers on the web",
    "tiles/tileset.json": "the splat as 3D Tiles, for web globes (CesiumJS)",
    "tiles/index.html": "page that shows the tiles on the globe",
    "tiles/splat.glb": "the splat in one glTF file",
    "cameras/cameras.csv": "positions, angles and σ of the photographs, for photogrammetry",
    "cameras/camera_covariances.csv": "full covariance of every photograph, for weighted solutions",
    "cameras/covariances.npz": "the same as arrays, and the covariance of every tie point",
    "cameras/colmap": "adjusted cameras and points as a COLMAP model, for other trainers",
    "cameras/transforms.json": "adjusted cameras for nerfstudio",
    "cameras/footprints.geojson": "ground that each photograph shows, for maps",
    "report/report.html": "report to hand in: one page with accuracy, points, photographs and processing",
    "report/report.pdf": "the same report, for printing",
    "evaluate/report.json": "measured and predicted accuracy, for the record",
    "evaluate/cameras.csv": "σ of every photograph",
    "evaluate/points.csv": "error of each check and control point",
    "evaluate/accuracy.png": "map of the predicted accuracy, with the errors of the points",
    "evaluate/accuracy.csv": "the same map as a table",
}
