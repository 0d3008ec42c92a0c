"""Pictures of the viewer: renders of the trained model, photographs over them, and false colours.

The machine that holds the model draws them, with the rasteriser that trained it: what is seen is what is measured,
colours that depend on the direction included, and a page without a graphics card shows millions of Gaussians.

The viewer's frame is `geo` moved to the middle of the scene: metres, east, north, up.
"""

import threading
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal

import cv2
import numpy as np
import torch

from pipelines.adjust.accuracy_grid import AccuracyGrid
from pipelines.core.errors import InputError
from pipelines.core.plan import photograph_folder
from pipelines.core.types import ByteArray, Float32Array, FloatArray
from pipelines.core.workspace import Workspace
from pipelines.geometry.cameras import Camera, Pinhole, ViewPose, distort, undistort
from pipelines.geometry.similarity import Similarity
from pipelines.geometry.sparse_model import SparseModel
from pipelines.report.plots.style import colours_of
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.surface import measured_depth
from pipelines.surface.picking import Sight
from pipelines.surface.surface_views import ModelRenderer
from pipelines.survey.area import photographs_that_see
from pipelines.survey.photographs import decoded_photograph
from pipelines.survey.solution import Solution
from pipelines.survey.survey import Survey
from pipelines.view.motion import MotionModels

Colouring = Literal["photographs", "height", "sigma", "views"]
Box = tuple[float, float, float, float, float, float]  # west, south, low, east, north, high
_RIM = 0.02  # share of the SfM points outside the scene, on each side
_KEPT_PHOTOGRAPHS = 3  # at full size, in memory
_SAME_PLACE = 1e-4  # of the scene's radius: a camera this near to a photograph's sees what it saw
_EDGE_POINTS = 9  # on each side of a photograph
_DEPTH_PX = 200  # of the longer side of the depth that a page gets
_TINT = 0.7  # of false colours
_COARSE_PX = 8  # pixels of one false colour that is not of the height


@dataclass(frozen=True)
class ViewerCamera:
    """Camera of a page, in the frame of the viewer."""

    rotation: FloatArray  # (3, 3) camera ← view; the camera's axes are x right, y down, z forward
    position: FloatArray  # (3,)
    fov_rad: float  # vertical field of view
    width: int  # of the page in pixels
    height: int  # likewise

    def pinhole(self) -> Pinhole:
        focal = self.height / 2 / np.tan(self.fov_rad / 2)
        return Pinhole(self.width, self.height, focal, focal, self.width / 2, self.height / 2)


_NEAR = 4.0  # radii of the scene, from which a line of sight begins at most
_FADED = 2.0, 3.0  # radii between which Gaussians fade away, in views that are no photographs


@dataclass(frozen=True)
class ViewFrame:
    """Frame of the viewer, and the radius of the scene."""

    view_from_model: Similarity
    middle_in_geo: FloatArray  # (3,)
    radius_m: float

    def pose(self, camera: ViewerCamera) -> ViewPose:
        """Return a page's camera in `model`."""
        center = self.view_from_model.inverse().apply(camera.position[None])[0]
        return ViewPose(camera.pinhole(), camera.rotation @ self.view_from_model.rotation, center)

    def sight(self, camera: ViewerCamera, x: float, y: float) -> Sight:
        """Return the line of sight in `model` through a pixel of a page."""
        pose = self.pose(camera)
        direction = pose.cam_from_model.T @ pose.pinhole.rays(np.array([[x, y]]))[0]
        direction, pixel_rad, start = (
            direction / np.linalg.norm(direction),
            1.0 / pose.pinhole.fx,
            pose.center_in_model,
        )
        # A view with hardly any perspective stands so far away that shares of its distance are no tolerances.
        model_from_view = self.view_from_model.inverse()
        middle, near = model_from_view.apply(np.zeros((1, 3)))[0], _NEAR * self.radius_m * model_from_view.scale
        away = float(direction @ (middle - start))
        if away > near:
            start, pixel_rad = start + (away - near) * direction, pixel_rad * away / near
        return Sight(start, direction, pixel_rad)

    def from_geo(self, point_in_geo: FloatArray) -> FloatArray:
        """Return places (…, 3) in the viewer's frame."""
        return np.asarray(point_in_geo - self.middle_in_geo)


def frame_of(solution: Solution, sfm: SparseModel) -> ViewFrame:
    """Return the frame of a solution's scene: its SfM points without the rim, or its cameras without any."""
    in_geo = solution.center_in_geo
    if len(sfm.point_in_local):
        in_geo = solution.similarity.apply(solution.point_in_model(sfm))
    low, high = np.quantile(in_geo, [_RIM, 1 - _RIM], axis=0)
    radius_m = max(float(np.linalg.norm(high - low)) / 2, 1e-3)
    middle = (low + high) / 2
    return ViewFrame(Similarity(1.0, np.eye(3), -middle) @ solution.similarity, middle, radius_m)


class Photographs:
    """Photographs of the survey at full size, decoded on demand."""

    def __init__(self, workspace: Workspace, survey: Survey, sparse: SparseModel) -> None:
        self._folder, self._sparse = photograph_folder(workspace, survey.image_dir), sparse
        self._sha256 = {image.name: image.sha256 for image in survey.images}
        self.full = lru_cache(_KEPT_PHOTOGRAPHS)(self._decoded)

    def _decoded(self, camera: int) -> ByteArray:
        """Return a photograph (H, W, 3) with its distortion; an InputError: unreadable, or not of the survey."""
        name = self._sparse.image_name[camera]
        file = self._folder / name
        pixels = decoded_photograph(file, self._sha256.get(name, ""))
        lens = self._sparse.camera_of(camera)
        if pixels is None or pixels.shape[:2] != (lens.height, lens.width):
            message = "cannot be decoded, or has another size than its camera."
            remedy = "Restore the photograph."
            raise InputError("photograph-damaged", message, path=file, remedy=remedy)
        return np.ascontiguousarray(pixels[..., ::-1])


@dataclass(frozen=True)
class Wanted:
    """Content of a picture, as a page asks for it.

    Attributes:
        photograph: camera of the trained model whose photograph lies over the picture; None: none.
        share: of the photograph, 0 … 1.
        background: (3,) colour 0 … 1 where there is no Gaussian.
        box: of which the Gaussians are shown, in the viewer's frame; None: all.
        moving: the picture is one of many, and may be coarse.
    """

    photograph: int | None = None
    share: float = 1.0
    colouring: Colouring = "photographs"
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    box: Box | None = None
    moving: bool = False


@dataclass(frozen=True)
class PageView:
    """Picture (H, W, 3) of a page, depth (h, w) along the camera's z axis in metres, and what its colours mean.

    The depth is smaller than the picture; 0: nothing there. `scale` has the values of the darkest and the brightest
    colour, where colours are false.
    """

    rgb: ByteArray
    depth: Float32Array
    scale: tuple[float, float] | None = None


class Painter:
    """Painter of the pictures of pages."""

    def __init__(
        self, renderer: ModelRenderer, photographs: Photographs, frame: ViewFrame, grid: AccuracyGrid | None
    ) -> None:
        self._renderer, self._photographs, self._frame, self._grid = renderer, photographs, frame, grid
        self._renderer_of = lru_cache(2)(lambda box, faded: renderer.showing(self._clipped(box, faded)))
        self._making = threading.Lock()
        self._motion: MotionModels | None = None

    def prepare_motion(self, ended: threading.Event) -> None:
        """Make the coarser models of the whole scene for pictures that move; `ended` gives up."""
        with self._making:
            self._motion = MotionModels(self._renderer_of(None, True))
        self._motion.make(ended)

    def paint(self, camera: ViewerCamera, wanted: Wanted) -> PageView:
        """Return the picture of a page's camera; a photograph over it shows only from its own place.

        Raises:
            InputError: the photograph cannot be read.
        """
        pose = self._frame.pose(camera)
        whole = wanted.photograph is None and wanted.box is None
        if wanted.moving and whole and self._motion is not None:
            render = self._motion.render(pose)
        else:
            with self._making:
                renderer = self._renderer_of(wanted.box, whole)
            render = renderer.render(pose, depth=True)
        depth = measured_depth(render).cpu().numpy() * self._frame.view_from_model.scale
        behind = torch.tensor(wanted.background) - torch.tensor(self._renderer.model.background)
        colour = render.colour.cpu() + (1 - render.alpha.cpu())[..., None] * behind
        rgb, scale = (255 * colour.clamp(0, 1)).round().byte().numpy(), None
        if wanted.colouring != "photographs":
            rgb, scale = self._false_colours(rgb, depth, camera, wanted.colouring)
        if wanted.photograph is not None and wanted.share > 0:
            apart = self._renderer.poses.cam_center_in_model[wanted.photograph] - pose.center_in_model
            if float(np.linalg.norm(apart)) < _SAME_PLACE * self._frame.radius_m:
                rgb = self._blended(rgb, wanted, pose)
        shrunk = min(1.0, _DEPTH_PX / max(depth.shape))
        small = [max(round(side * shrunk), 1) for side in depth.shape[::-1]]
        coarse = cv2.resize(depth.astype(np.float32), small, interpolation=cv2.INTER_NEAREST)
        return PageView(rgb, np.asarray(coarse, dtype=np.float32), scale)

    def _clipped(self, box: Box | None, faded: bool) -> Gaussians:
        """Return the Gaussians in a box, or those that are not far from the scene."""
        gaussians = self._renderer.gaussians
        if box is None and not faded:
            return gaussians
        places = self._frame.view_from_model.apply(gaussians.means.double().numpy())
        if box is None:
            whole, gone = (factor * self._frame.radius_m for factor in _FADED)
            share = torch.from_numpy(np.clip((gone - np.linalg.norm(places, axis=1)) / (gone - whole), 1e-6, 1.0))
            if bool((share == 1).all()):
                return gaussians
            opacity = torch.sigmoid(gaussians.logit_opacities) * share.float()
            logit = torch.where(share == 1, gaussians.logit_opacities, torch.logit(opacity))
            return replace(gaussians, logit_opacities=logit)
        inside = ((places >= box[:3]) & (places <= box[3:])).all(axis=1)
        return gaussians.select(torch.from_numpy(inside))

    def _false_colours(
        self, rgb: ByteArray, depth: FloatArray, camera: ViewerCamera, colouring: Colouring
    ) -> tuple[ByteArray, tuple[float, float] | None]:
        """Return a picture tinted by height, predicted σ, or number of photographs, and the range of the values."""
        step = 1 if colouring == "height" else _COARSE_PX
        rows, columns = np.arange(step // 2, depth.shape[0], step), np.arange(step // 2, depth.shape[1], step)
        z = depth[np.ix_(rows, columns)]
        pixel = np.stack(np.meshgrid(columns + 0.5, rows + 0.5), axis=-1)
        place = (z[..., None] * camera.pinhole().rays(pixel)) @ camera.rotation + camera.position
        known = z > 0
        values = np.zeros(z.shape)
        if not known.any() or (colouring == "sigma" and self._grid is None):
            return rgb, None
        in_geo = place[known] + self._frame.middle_in_geo
        if colouring == "sigma" and self._grid is not None:
            covered = self._grid.covers(in_geo)  # beyond the scene, the σ of its rim says nothing
            known[known], in_geo = covered, in_geo[covered]
        if colouring == "height":
            values[known] = in_geo[:, 2]
        elif colouring == "sigma" and self._grid is not None:
            values[known] = np.sqrt(np.trace(self._grid.cov_at(in_geo), axis1=1, axis2=2))
        else:
            values[known] = photographs_that_see(self._renderer.model, self._renderer.sfm, in_geo)
        low, high = np.quantile(values[known], [0.02, 0.98]).tolist() if known.any() else (0.0, 1.0)
        tint = colours_of(values.ravel(), low, high).reshape(*values.shape, 3)
        whole = cv2.resize(np.ascontiguousarray(tint), rgb.shape[1::-1], interpolation=cv2.INTER_NEAREST)
        is_known = cv2.resize(known.astype(np.uint8), rgb.shape[1::-1], interpolation=cv2.INTER_NEAREST) > 0
        grey = cv2.cvtColor(np.ascontiguousarray(rgb), cv2.COLOR_RGB2GRAY)[..., None]
        mixed = np.where(is_known[..., None], _TINT * whole + (1 - _TINT) * grey, grey)  # grey: not known
        mixed = np.where((depth > 0)[..., None], mixed, rgb)
        return np.asarray(mixed, dtype=np.uint8), (low, high) if known.any() else None

    def _blended(self, rgb: ByteArray, wanted: Wanted, pose: ViewPose) -> ByteArray:
        """Return a picture with the photograph over it, as the photograph's lens shows the picture's rays."""
        camera = wanted.photograph
        assert camera is not None
        height, width = rgb.shape[:2]
        pixels = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1)
        turn = self._renderer.poses.cam_from_model[camera] @ pose.cam_from_model.T
        ray = pose.pinhole.rays(pixels) @ turn.T
        ahead = ray[..., 2] > 0
        slope = ray[..., :2] / np.where(ahead, ray[..., 2], 1.0)[..., None]
        lens = self._renderer.sparse.camera_of(camera)
        place = np.asarray(distort(lens, slope)) - 0.5
        # Beyond its fold a lens polynomial leads back into the picture, to the pixel of another ray.
        ahead &= np.linalg.norm(slope, axis=-1) < _widest_slope(lens)
        inside = ahead & ((place > -0.5) & (place < np.array([lens.width, lens.height]) - 0.5)).all(axis=-1)
        source = np.where(inside[..., None], place, -1.0).astype(np.float32)
        full = self._photographs.full(camera)
        photograph = cv2.remap(full, source[..., 0], source[..., 1], cv2.INTER_LINEAR)
        share = np.where(inside, wanted.share, 0.0)[..., None]
        return np.asarray(np.round(share * photograph + (1 - share) * rgb), dtype=np.uint8)


def _widest_slope(lens: Camera) -> float:
    """Return the largest tangent of the angle between the axis and a ray to the edge of the photograph."""
    across, down = np.linspace(0, lens.width, _EDGE_POINTS), np.linspace(0, lens.height, _EDGE_POINTS)
    edge = [(x, y) for x in across for y in (0, lens.height)] + [(x, y) for x in (0, lens.width) for y in down]
    return float(np.nanmax(np.linalg.norm(undistort(lens, edge), axis=-1))) * (1 + 1e-3)
