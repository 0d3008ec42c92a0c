// Cameras of the page. The frame is metres east, north, up of the middle of the scene; a camera's axes are x right,
// y down, z forward, and its rotation (camera from scene) is a list of nine numbers, row by row.

export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const add = (a, b, by = 1) => [a[0] + by * b[0], a[1] + by * b[1], a[2] + by * b[2]];
export const minus = (a, b) => add(a, b, -1);
export const norm = (a) => Math.hypot(...a);
export const row = (rotation, k) => rotation.slice(3 * k, 3 * k + 3);

const DEGREE = Math.PI / 180;

// Camera that looks at a place: heading from north over east, pitch below the horizon, in degrees.
export function orbit({ target, distance, heading, pitch, fov }, width, height) {
  const [h, p] = [heading * DEGREE, pitch * DEGREE];
  const forward = [Math.cos(p) * Math.sin(h), Math.cos(p) * Math.cos(h), -Math.sin(p)];
  const right = [Math.cos(h), -Math.sin(h), 0];
  const down = [
    forward[1] * right[2] - forward[2] * right[1],
    forward[2] * right[0] - forward[0] * right[2],
    forward[0] * right[1] - forward[1] * right[0],
  ];
  return { position: add(target, forward, -distance), rotation: [...right, ...down, ...forward], fov, width, height };
}

// Camera of a photograph, wide enough to show all of it.
export function ofPhotograph({ at, rotation, half }, width, height) {
  const fov = 2 * Math.atan(Math.max(half[1], half[0] * height / width) * 1.04);
  return { position: at, rotation, fov, width, height };
}

export const focal = ({ fov, height }) => height / 2 / Math.tan(fov / 2);

// Pixel and depth of a place; depth is not positive behind the camera.
export function project(camera, place) {
  const ray = minus(place, camera.position), f = focal(camera);
  const [x, y, z] = [0, 1, 2].map((k) => dot(row(camera.rotation, k), ray));
  return { x: f * x / z + camera.width / 2, y: f * y / z + camera.height / 2, z };
}

// Place at a depth under a pixel.
export function placeAt(camera, x, y, depth) {
  const f = focal(camera);
  const inCamera = [(x - camera.width / 2) / f * depth, (y - camera.height / 2) / f * depth, depth];
  return inCamera.reduce((sum, value, k) => add(sum, row(camera.rotation, k), value), camera.position);
}

// The largest round number (1, 2 or 5 times a power of ten) that is not above a value.
export function rounded(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return [5, 2, 1].find((factor) => factor * power <= value) * power;
}

// A value with as many decimals as two figures of its σ have.
export function sensible(value, sigma, most = 3) {
  if (!(sigma > 0)) return value.toFixed(most);
  const decimals = Math.min(Math.max(1 - Math.floor(Math.log10(sigma)), 0), 6);
  return value.toFixed(decimals);
}
export const withSigma = (value, sigma, unit, most = 3) =>
  `${sensible(value, sigma, most)}${sigma > 0 ? ` ± ${sensible(sigma, sigma)}` : ""} ${unit}`;
