"""Textures: albedo of every material, such as walls with windows, roofs, ground, leaves, cars, targets.

A texture that aliases gives every photograph other features at the same place. Every pattern therefore takes the
width of the pixel on the surface, and filters itself: a box filter for stripes, fading for noise and random cells.
"""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike

from pipelines.core.types import ByteArray, Float32Array, rows_of
from pipelines.formats.fiducials import tag_modules
from pipelines.simulate.mesh import Material

_LATTICE, _UPSAMPLE = 128, 4
Image = ByteArray | Float32Array
_WIDTH = 256  # width of the image into which samples are arranged for cv2.remap


def _noise_table() -> Float32Array:
    """Return a periodic image of smooth noise in 0…1; part of the algorithm, hence of fixed seed."""
    lattice = np.random.default_rng(20260112).random((_LATTICE, _LATTICE)).astype(np.float32)
    padded = np.pad(lattice, 4, mode="wrap")
    size = (_LATTICE + 8) * _UPSAMPLE
    smooth = cv2.resize(padded, (size, size), interpolation=cv2.INTER_CUBIC)
    crop = 4 * _UPSAMPLE
    return np.ascontiguousarray(smooth[crop:-crop, crop:-crop])


_NOISE = _noise_table()


def sample(image: Image, x: Float32Array, y: Float32Array, *, wrap: bool) -> Float32Array:
    """Return bilinear samples of an image at pixel coordinates (N,), as float32 (N,) or (N, channels)."""
    count = len(x)
    rows = max(1, -(-count // _WIDTH))
    maps = np.zeros((2, rows * _WIDTH), dtype=np.float32)
    maps[0, :count], maps[1, :count] = x, y
    border = cv2.BORDER_WRAP if wrap else cv2.BORDER_REPLICATE
    grids = maps.reshape(2, rows, _WIDTH)
    samples = cv2.remap(image, grids[0], grids[1], cv2.INTER_LINEAR, borderMode=border)
    return np.asarray(samples.reshape(rows * _WIDTH, *samples.shape[2:])[:count], dtype=np.float32)


def visible(size: float, pixel: Float32Array) -> Float32Array:
    """Return the contrast, 0…1, of a pattern of period 2 · `size` metres in pixels of width `pixel` (N,)."""
    return np.clip((2.0 * size / np.maximum(pixel, 1e-6) - 1.5) / 1.5, 0.0, 1.0).astype(np.float32)


def noise(u: Float32Array, v: Float32Array, size: float, pixel: Float32Array) -> Float32Array:
    """Return smooth noise (N,) in about −0.5…0.5 with blobs of `size` metres."""
    strength = visible(size, pixel)
    shown = np.nonzero(strength)[0]
    if len(shown) < len(strength):  # noise that is too fine to be visible need not be looked up
        value = np.zeros_like(strength)
        if len(shown):
            value[shown] = _look_up(u[shown], v[shown], size) * strength[shown]
        return value
    return _look_up(u, v, size) * strength


def _look_up(u: Float32Array, v: Float32Array, size: float) -> Float32Array:
    scale = np.float32(_UPSAMPLE / size)
    period = np.float32(_LATTICE * _UPSAMPLE)
    # The modulo is written out: np.mod takes longer than the look-up, and cv2.remap has 16-bit coordinates only.
    x, y = u * scale, v * scale
    x -= period * np.floor(x / period)
    y -= period * np.floor(y / period)
    return sample(_NOISE, x, y, wrap=True) - np.float32(0.5)


def fbm(
    u: Float32Array, v: Float32Array, sizes: tuple[float, ...], pixel: Float32Array, gain: float = 0.8
) -> Float32Array:
    """Return noise (N,) of several sizes, each `gain` times as strong as the size before."""
    total = np.zeros_like(u)
    strength = 1.0
    for i, size in enumerate(sizes):
        shift = np.float32(17.31 * i)
        # Each octave is turned, so that the lattices do not line up.
        u, v = u * np.float32(0.8) + v * np.float32(0.6), v * np.float32(0.8) - u * np.float32(0.6)
        total += np.float32(strength) * noise(u + shift, v - shift, size, pixel)
        strength *= gain
    return total


def cell_random(i: Float32Array, j: Float32Array, salt: int) -> Float32Array:
    """Return a random number (N,) in 0…1 for every cell (i, j) of whole numbers."""
    bits = i.astype(np.int32).view(np.uint32) * np.uint32(374761393)
    bits += j.astype(np.int32).view(np.uint32) * np.uint32(668265263)
    bits += np.uint32(salt * 2654435761 & 0xFFFFFFFF)
    bits = (bits ^ (bits >> np.uint32(13))) * np.uint32(1274126177)
    bits ^= bits >> np.uint32(16)
    return (bits >> np.uint32(8)).astype(np.float32) * np.float32(2**-24)


def stripes(x: Float32Array, period: ArrayLike, width: ArrayLike, pixel: Float32Array) -> Float32Array:
    """Return the share (N,) of the pixel covered by stripes [0, width) of every period, box-filtered exactly."""
    every, wide = np.asarray(period, dtype=np.float32), np.asarray(width, dtype=np.float32)
    reach = np.maximum(pixel, np.float32(1e-4)).astype(np.float32)

    def covered(end: Float32Array) -> Float32Array:
        whole = np.floor(end / every)
        return np.asarray(whole * wide + np.minimum(end - whole * every, wide))

    low, high = covered(x - reach / np.float32(2)), covered(x + reach / np.float32(2))
    return np.asarray(np.clip((high - low) / reach, 0.0, 1.0).astype(np.float32))


def band(x: Float32Array, low: ArrayLike, high: ArrayLike, pixel: Float32Array) -> Float32Array:
    """Return the share (N,) of the pixel that lies in low…high, box-filtered exactly."""
    reach = np.maximum(pixel, np.float32(1e-4))
    half = reach / np.float32(2)
    low, high = np.asarray(low, dtype=np.float32), np.asarray(high, dtype=np.float32)
    inside = np.minimum(x + half, high) - np.maximum(x - half, low)
    return np.asarray(np.clip(inside / reach, 0.0, 1.0).astype(np.float32))


def mix(a: Float32Array, b: Float32Array, share: Float32Array) -> Float32Array:
    """Return a (N, 3) and b (N, 3) or (3,), blended by `share` (N,) of b."""
    return a + (b - a) * share[:, None]


class Pyramid:
    """Image pyramid of an image (H, W, 3) uint8 with pixels of `pixel_m`, for sampling at any distance."""

    def __init__(self, image: ByteArray, pixel_m: float) -> None:
        self._pixel_m = pixel_m
        self._levels = [image]
        while min(self._levels[-1].shape[:2]) > 16:
            height, width = self._levels[-1].shape[:2]
            smaller = cv2.resize(self._levels[-1], (width // 2, height // 2), interpolation=cv2.INTER_AREA)
            self._levels.append(np.asarray(smaller, dtype=np.uint8))

    def sample(self, u: Float32Array, v: Float32Array, pixel: Float32Array) -> Float32Array:
        """Return values (N, 3) in 0…1 at (u, v) metres from the image's centre, filtered to `pixel` (N,) metres."""
        level = np.clip(np.log2(np.maximum(pixel / self._pixel_m, 1.0)), 0, len(self._levels) - 1.001)
        whole = level.astype(np.int32)
        total = np.zeros((len(u), 3), dtype=np.float32)
        for k in range(int(whole.min(initial=0)), int(whole.max(initial=0)) + 2):
            weight = 1 - np.abs(level - k)
            chosen = np.nonzero(weight > 0)[0]
            if len(chosen):
                image = self._levels[k]
                scale = np.float32(1 / (self._pixel_m * 2**k))
                x = u[chosen] * scale + np.float32(image.shape[1] / 2 - 0.5)
                y = v[chosen] * scale + np.float32(image.shape[0] / 2 - 0.5)
                total[chosen] += weight[chosen, None].astype(np.float32) * sample(image, x, y, wrap=False)
        return total / np.float32(255)


BASE, ACCENT = slice(0, 3), slice(3, 6)
STYLE, FLOOR, PITCH, WINDOW_W, WINDOW_H, SILL, TOP, SHOP, SHIFT_U, SHIFT_V = range(6, 16)


@dataclass(frozen=True)
class TextureSamples:
    """N points on surfaces of one material, at which its texture is sampled."""

    u: Float32Array  # (N,) texture coordinates in metres
    v: Float32Array  # (N,)
    du: Float32Array  # (N,) width of a pixel along u, in metres
    dv: Float32Array  # (N,)
    params: Float32Array  # (N, 16) rows of `Mesh.texture_params`

    @property
    def pixel(self) -> Float32Array:
        """Width of a pixel for patterns without direction; slightly small, because images are supersampled."""
        return np.float32(0.75) * np.maximum(self.du, self.dv)


@dataclass(frozen=True)
class GroundPlan:
    """Paint of the ground: colour (square root of albedo), and shares of grass, paving, asphalt."""

    color: Pyramid
    kind: Pyramid
    reach_m: float


def _tinted(base: Float32Array, amount: Float32Array) -> Float32Array:
    return base * np.clip(1 + amount, 0.15, 2.5)[:, None]


def _grime(s: TextureSamples) -> Float32Array:
    """Return weathering: blotches, and streaks that run down the wall."""
    u, v = s.u + s.params[:, SHIFT_U], s.v + s.params[:, SHIFT_V]
    blotches = fbm(u, v, (3.1, 1.3, 0.55, 0.24, 0.1), s.pixel)
    streaks = noise(u, v * np.float32(0.12), 0.45, s.pixel)
    return np.float32(0.42) * blotches + np.float32(0.22) * streaks


def _masonry(
    s: TextureSamples, stone_m: tuple[float, float], joint: float, salt: int
) -> tuple[Float32Array, Float32Array]:
    """Return the tone of each stone, and the share of joints."""
    length, height = stone_m
    row = np.floor(s.v / np.float32(height))
    along = s.u + np.float32(0.5 * length) * np.mod(row, 2)
    tone = cell_random(np.floor(along / np.float32(length)), row, salt) - np.float32(0.5)
    joints = np.maximum(stripes(along, length, joint, s.du), stripes(s.v, height, joint, s.dv))
    return tone * visible(height, s.pixel), joints


def wall(s: TextureSamples) -> Float32Array:
    """Return a facade: plaster, masonry or panels, with plinth, windows, frames, sills, curtains and shops."""
    color = _tinted(s.params[:, BASE], _grime(s))
    for style, stone_m, joint, contrast in ((1, (0.8, 0.4), 0.035, 0.75), (2, (3.0, 1.5), 0.05, 0.3)):
        of_style = np.nonzero(s.params[:, STYLE] == style)[0]
        if len(of_style):
            tone, joints = _masonry(rows_of(s, of_style), stone_m, joint, style)
            color[of_style] = mix(
                _tinted(color[of_style], contrast * tone), color[of_style] * np.float32(0.5), joints
            )
    plinth = band(s.v, -50.0, 0.7, s.dv)
    color = mix(color, s.params[:, BASE] * np.float32(0.35) + np.float32(0.05), plinth * np.float32(0.8))
    cornice = band(s.v, s.params[:, TOP] + 0.05, s.params[:, TOP] + 0.3, s.dv)
    color = mix(color, s.params[:, ACCENT], cornice)
    return _add_windows(s, color)


def _add_windows(s: TextureSamples, color: Float32Array) -> Float32Array:
    floor, pitch = s.params[:, FLOOR], s.params[:, PITCH]
    storey, column = np.floor(s.v / floor), np.floor(s.u / pitch)
    x, y = s.u - (column + np.float32(0.5)) * pitch, s.v - storey * floor
    salt_u, salt_v = s.params[:, SHIFT_U], s.params[:, SHIFT_V]
    luck, mood = (cell_random(column + salt_u, storey + salt_v, salt) for salt in (3, 4))
    ground = storey < 1
    shop = ground & (s.params[:, SHOP] > 0)
    half = np.where(shop, np.float32(0.42) * pitch, s.params[:, WINDOW_W] / 2)
    low = np.where(shop, np.float32(0.35), s.params[:, SILL])
    high = np.where(shop, np.float32(2.5), s.params[:, SILL] + s.params[:, WINDOW_H])
    door = ground & ~shop & (luck < 0.2)
    low, high = np.where(door, 0.0, low), np.where(door, 2.2, high)
    exists = ((s.v > 0) & ((storey + 1) * floor <= s.params[:, TOP] + 0.05) & (luck < 0.93)).astype(np.float32)
    frame_m = np.float32(0.14)
    hole = band(x, -half - frame_m, half + frame_m, s.du) * band(y, low - frame_m, high + frame_m, s.dv) * exists
    pane = band(x, -half, half, s.du) * band(y, low, high, s.dv) * exists
    pane *= 1 - band(x, -0.05, 0.05, s.du) * (~door)
    sill = band(x, -half - 0.25, half + 0.25, s.du) * band(y, low - 0.32, low - frame_m, s.dv) * exists * (~door)
    color = mix(color, np.array([0.5, 0.48, 0.44], dtype=np.float32), sill)
    color = mix(color, s.params[:, ACCENT], hole)
    glass = np.array([0.035, 0.05, 0.065], dtype=np.float32) * (np.float32(0.5) + 2 * mood)[:, None]
    curtain_low = low + (high - low) * np.where(luck > 0.45, np.float32(0.25) + mood, 2.0)
    curtain = band(y, curtain_low, high, s.dv)
    tint = np.array([0.42, 0.38, 0.32], dtype=np.float32) * (np.float32(0.4) + luck)[:, None]
    glass = np.where(door[:, None], s.params[:, ACCENT] * np.float32(0.35), mix(glass, tint, curtain * (~door)))
    return mix(color, glass, pane)


def tiles(s: TextureSamples) -> Float32Array:
    """Return a pitched roof: rows of tiles, each of its own tone, with moss and darker patches."""
    row = np.floor(s.v / np.float32(0.4))
    along = s.u + np.float32(0.15) * np.mod(row, 2)
    tone = (cell_random(np.floor(along / np.float32(0.3)), row, 5) - np.float32(0.5)) * visible(0.3, s.pixel)
    patch = cell_random(np.floor(s.u / np.float32(1.7)), np.floor(s.v / np.float32(1.2)), 6) - np.float32(0.5)
    color = _tinted(s.params[:, BASE], 0.8 * tone + 0.35 * patch * visible(1.2, s.pixel) + _grime(s))
    lap = stripes(s.v, 0.4, 0.07, s.dv)
    color = mix(color, color * np.float32(0.45), lap)
    u, v = s.u + s.params[:, SHIFT_U], s.v + s.params[:, SHIFT_V]
    moss = np.clip(3 * fbm(u, v, (2.3, 0.9, 0.35), s.pixel) - np.float32(0.9), 0, 0.7)
    return mix(color, np.array([0.09, 0.11, 0.04], dtype=np.float32), moss)


def flat_roof(s: TextureSamples) -> Float32Array:
    """Return bitumen sheets or gravel, with repairs, puddle stains and seams."""
    u, v = s.u + s.params[:, SHIFT_U], s.v + s.params[:, SHIFT_V]
    color = _tinted(s.params[:, BASE], 0.7 * fbm(u, v, (2.9, 1.2, 0.5, 0.22, 0.1), s.pixel, 0.85))
    repair = cell_random(np.floor(u / np.float32(2.2)), np.floor(v / np.float32(1.3)), 7)
    inset = stripes(u, 2.2, 1.7, s.du) * stripes(v, 1.3, 1.05, s.dv)
    color = mix(color, s.params[:, ACCENT], inset * (repair > 0.82) * np.float32(0.8))
    stain = np.clip(4 * noise(u + 31, v, 1.9, s.pixel) - np.float32(0.9), 0, 0.55)
    color = mix(color, color * np.float32(0.35), stain)
    return mix(color, color * np.float32(0.5), stripes(s.v, 1.0, 0.05, s.dv))


def weathered(s: TextureSamples) -> Float32Array:
    """Return weathered concrete, painted metal or bark, with louvres that show up close."""
    louvre = stripes(s.v, 0.25, 0.07, s.dv)
    return mix(_tinted(s.params[:, BASE], _grime(s)), s.params[:, BASE] * np.float32(0.5), louvre * np.float32(0.5))


def leaves(s: TextureSamples) -> Float32Array:
    """Return foliage: clumps of light and dark."""
    u, v = s.u + s.params[:, SHIFT_U], s.v + s.params[:, SHIFT_V]
    clumps = fbm(u, v, (1.1, 0.5, 0.24, 0.12), s.pixel, 0.9)
    color = _tinted(s.params[:, BASE], 1.5 * clumps)
    return mix(color, s.params[:, ACCENT], np.clip(2 * clumps, 0, 0.6))


def car(s: TextureSamples) -> Float32Array:
    """Return a painted body; the cabin, marked by `TOP`, has dark windows."""
    windows = band(s.v, 0.08, 0.47, s.dv) * stripes(s.u - np.float32(0.1), 1.15, 1.0, s.du) * (s.params[:, TOP] > 0)
    return mix(_tinted(s.params[:, BASE], 0.15 * _grime(s)), np.float32(0.03) + 0 * s.params[:, BASE], windows)


def solar(s: TextureSamples) -> Float32Array:
    """Return solar modules: dark cells in a bright grid."""
    frame = np.maximum(stripes(s.u, 1.0, 0.06, s.du), stripes(s.v, 1.65, 0.06, s.dv))
    cells = np.maximum(stripes(s.u, 0.166, 0.012, s.du), stripes(s.v, 0.166, 0.012, s.dv))
    color = mix(_tinted(s.params[:, BASE], 0.25 * _grime(s)), s.params[:, BASE] * 3, cells)
    return mix(color, np.array([0.45, 0.46, 0.48], dtype=np.float32), frame)


def target(s: TextureSamples) -> Float32Array:
    """Return a survey target: black and white quarters about the origin of the coordinates, `PITCH` wide."""
    half = s.params[:, PITCH] / 2
    right, upper = band(s.u, 0.0, half, s.du), band(s.v, 0.0, half, s.dv)
    left, lower = band(s.u, -half, 0.0, s.du), band(s.v, -half, 0.0, s.dv)
    white = right * upper + left * lower
    return np.repeat((np.float32(0.03) + np.float32(0.75) * white)[:, None], 3, axis=1)


# Dictionaries of tags by the style of their texture. Those of 50, 100 and 250 tags begin that of 1000.
TAG_DICTIONARIES = ("DICT_4X4_1000", "DICT_APRILTAG_36h11")


def tag(s: TextureSamples) -> Float32Array:
    """Return ArUco or AprilTags about the origin of the coordinates, `PITCH` wide, on white boards."""
    white = np.ones(len(s.u), dtype=np.float32)
    for style, number in np.unique(s.params[:, [STYLE, SHIFT_U]], axis=0).astype(int):
        of_tag = np.nonzero((s.params[:, STYLE] == style) & (s.params[:, SHIFT_U] == number))[0]
        modules = tag_modules(TAG_DICTIONARIES[style], int(number)).astype(np.float32)
        part, count = rows_of(s, of_tag), len(modules)
        edges = part.params[:, PITCH, None] * np.linspace(-0.5, 0.5, count + 1, dtype=np.float32)
        across, up = (
            band(x[:, None], edges[:, :-1], edges[:, 1:], width[:, None])
            for x, width in ((part.u, part.du), (part.v, part.dv))
        )
        beside = 1 - across.sum(axis=1) * up.sum(axis=1)
        white[of_tag] = beside + np.einsum("ni,ij,nj->n", up[:, ::-1], modules, across, optimize=True)
    return np.repeat((np.float32(0.03) + np.float32(0.75) * white)[:, None], 3, axis=1)


def ground(s: TextureSamples, plan: GroundPlan) -> Float32Array:
    """Return the painted plan with the grain of grass, paving and asphalt, and fields beyond."""
    # The plan is sampled sharper than the pixel: supersampling completes the filter.
    fine = np.sqrt(s.du * s.dv) * np.float32(0.6)
    color = np.square(plan.color.sample(s.u, s.v, fine))
    kind = plan.kind.sample(s.u, s.v, fine)
    away = np.maximum(np.abs(s.u), np.abs(s.v))
    outside = np.clip((away - np.float32(plan.reach_m - 12)) / np.float32(10), 0, 1)
    beyond = np.nonzero(outside > 0)[0]
    color[beyond] = mix(color[beyond], _fields(rows_of(s, beyond)), outside[beyond])
    kind *= (1 - outside)[:, None]
    kind[:, 0] += outside
    green = np.nonzero(kind[:, 0] > 0.02)[0]
    color[green] = _meadow(rows_of(s, green), color[green], kind[green, 0])
    hard = np.nonzero(kind[:, 1] + kind[:, 2] > 0.02)[0]
    color[hard] = _pavement(rows_of(s, hard), color[hard], kind[hard])
    return color


def _meadow(s: TextureSamples, color: Float32Array, grass: Float32Array) -> Float32Array:
    """Add blades and dry patches, by the share of grass."""
    grain = fbm(s.u, s.v, (7.0, 3.0, 1.3, 0.6, 0.28, 0.13), s.pixel, 0.85)
    color = _tinted(color, grass * np.float32(0.85) * grain)
    dry = grass * np.clip(np.float32(1.6) * grain, 0, 0.5)
    return mix(color, np.array([0.26, 0.23, 0.1], dtype=np.float32), dry)


def _pavement(s: TextureSamples, color: Float32Array, kind: Float32Array) -> Float32Array:
    """Add slabs and joints of paving, grit and cracks of asphalt."""
    paving, asphalt = kind[:, 1], kind[:, 2]
    grit = fbm(s.u + np.float32(50), s.v, (2.6, 1.1, 0.45, 0.2, 0.09), s.pixel, 0.9)
    slab, joints = _masonry(s, (1.6, 0.8), 0.05, 8)
    rough = (paving * np.float32(0.4) + asphalt * np.float32(0.75)) * grit
    color = _tinted(color, rough + paving * np.float32(0.55) * slab)
    tarred = np.nonzero(asphalt > 0.3)[0]
    t = rows_of(s, tarred)
    crack = np.abs(fbm(t.u, t.v + np.float32(90), (4.0, 1.7, 0.7), t.pixel)) < 0.012
    share = asphalt[tarred] * crack * visible(0.25, t.pixel)
    color[tarred] = mix(color[tarred], color[tarred] * np.float32(0.45), share)
    return mix(color, color * np.float32(0.5), paving * joints)


def _fields(s: TextureSamples) -> Float32Array:
    """Return a quilt of fields with furrows."""
    i, j = np.floor((s.u + np.float32(20)) / 90), np.floor((s.v - np.float32(35)) / 60)
    hue, tone = cell_random(i, j, 9), cell_random(i, j, 10)
    green, straw = np.array([[0.10, 0.17, 0.05], [0.33, 0.27, 0.12]], dtype=np.float32)
    color = (green + (straw - green) * (hue[:, None] ** 2)) * (np.float32(0.75) + np.float32(0.5) * tone)[:, None]
    furrow = stripes(np.where(hue > 0.5, s.u, s.v), 3.0, 0.9, s.pixel)
    edge = np.maximum(stripes(s.u + 20, 90.0, 2.0, s.du), stripes(s.v - 35, 60.0, 2.0, s.dv))
    return mix(mix(color, color * np.float32(0.75), furrow), green * np.float32(0.5), edge)


_TEXTURES: dict[Material, Callable[[TextureSamples], Float32Array]] = {
    Material.WALL: wall,
    Material.TILES: tiles,
    Material.FLAT_ROOF: flat_roof,
    Material.PLAIN: weathered,
    Material.LEAVES: leaves,
    Material.CAR: car,
    Material.SOLAR: solar,
    Material.TARGET: target,
    Material.TAG: tag,
}


def albedo(samples: TextureSamples, material: np.ndarray, plan: GroundPlan) -> Float32Array:
    """Return the linear albedo (N, 3) at N points of the given materials (N,)."""
    color = np.zeros((len(material), 3), dtype=np.float32)
    for kind in np.unique(material):
        chosen = np.nonzero(material == kind)[0]
        part = rows_of(samples, chosen)
        color[chosen] = ground(part, plan) if kind == Material.TERRAIN else _TEXTURES[Material(kind)](part)
    return color
