// The scene: pictures that the server draws, what lies over them, and the mouse, fingers and keys that move the camera.

import { add, focal, minus, norm, ofPhotograph, orbit, placeAt, project, rounded, row } from "./geometry.js";
import { ask, byId, change, onState, safely, state } from "./base.js";

const MOVING_MS = 120, STILL_MS = 180, LEAST_PX = 160, MOST_PX = 1920, CLICK_PX = 5, SNAP_PX = 10, DOUBLE_MS = 350;
const picture = byId("picture"), overlay = byId("overlay");
export let scene = null;  // what the server tells once
let shown = null;  // of the last picture: camera, depth, scale of false colours
let wanted = 0, drawing = null, movingPx = 480, stillTimer = null;
export const layers = [];  // functions that draw over the picture: (context, pixelOf, camera)
export const grips = {}, hovers = {};  // by tab: what a press takes hold of, and what follows the pointer
export const clicks = {};  // by tab: what a click does, and whether it is the second of a double click

export async function loadScene() {
  scene = await (await ask("scene")).json();
  if (!state.view) change({ view: home() });
  return scene;
}
// From far above with a narrow lens, nothing leans: as good as orthographic.
const NARROW = 0.05, WIDE = 0.9, away = (half, fov) => half / Math.tan(fov / 2);
export const fromAbove = (view) => ({ ...view, heading: 0, pitch: 90, fov: NARROW, distance: away(view.distance * Math.tan(view.fov / 2), NARROW) });
const inPerspective = (view) => (view.fov > NARROW ? view : { ...view, fov: WIDE, distance: away(view.distance * Math.tan(view.fov / 2), WIDE) });
// The area of interest from above, else the whole scene.
export function home() {
  const corners = scene.boundary.flat(), sides = [0, 1].map((k) => corners.map((corner) => corner[k]));
  const { clientWidth: width, clientHeight: height } = overlay;
  const ends = sides.map((values) => (values.length ? [Math.min(...values), Math.max(...values)] : [-scene.radius_m, scene.radius_m]));
  const half = Math.max((ends[1][1] - ends[1][0]) / 2, (ends[0][1] - ends[0][0]) / 2 * height / Math.max(width, 1));
  return fromAbove({ target: [(ends[0][0] + ends[0][1]) / 2, (ends[1][0] + ends[1][1]) / 2, 0], distance: away(1.08 * half, WIDE), heading: 0, pitch: 90, fov: WIDE });
}

export function camera() {
  const { clientWidth: width, clientHeight: height } = overlay;
  const of = scene.cameras[state.photo];
  return of ? ofPhotograph(of, width, height) : orbit(state.view, width, height);
}

// The light of the page: as the user or the browser wants it.
export function background() {
  const found = /(\d+), (\d+), (\d+)/.exec(getComputedStyle(document.body).backgroundColor) ?? [0, 0, 0, 0];
  return found.slice(1).map((value) => Number(value) / 255);
}

// Asks for a picture: a small one at once, a full one when the camera stands.
export function look() {
  if (!scene || overlay.clientWidth < 16) return;
  wanted += 1;
  clearTimeout(stillTimer);
  if (!drawing) draw(movingPx, 70);
  else if (drawing.full) drawing.controller.abort();
}

async function draw(longest, quality) {
  const number = wanted, seen = camera(), { colouring } = state;
  const density = longest >= MOST_PX ? Math.min(devicePixelRatio, 2) : 1;
  const factor = Math.min(density, longest / Math.max(seen.width, seen.height));
  const size = { width: Math.max(Math.round(seen.width * factor), 8), height: Math.max(Math.round(seen.height * factor), 8) };
  const controller = new AbortController(), began = performance.now();
  drawing = { controller, full: longest >= MOST_PX };
  try {
    const body = {
      rotation: seen.rotation, position: seen.position, fov: seen.fov, ...size, quality, photograph: state.photo,
      share: state.share, colouring, background: background(), box: state.box, moving: longest < MOST_PX,
    };
    const data = await (await ask("picture", { method: "POST", body, signal: controller.signal })).arrayBuffer();
    const length = new DataView(data).getUint32(0, true);
    const head = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length)));
    const jpeg = new Blob([new Uint8Array(data, 4 + length, head.jpeg)], { type: "image/jpeg" });
    const depth = new Float32Array(data, 4 + length + Math.ceil(head.jpeg / 4) * 4);
    const bitmap = await createImageBitmap(jpeg);
    Object.assign(picture, { width: bitmap.width, height: bitmap.height });
    picture.getContext("2d").drawImage(bitmap, 0, 0);
    shown = { camera: seen, depth, columns: head.depth[0], rows: head.depth[1], scale: head.scale, colouring, full: longest >= MOST_PX && number === wanted };
    if (!drawing.full) movingPx = Math.min(Math.max(movingPx * Math.min(Math.max(Math.sqrt(MOVING_MS / (performance.now() - began)), 0.5), 1.3), LEAST_PX), MOST_PX);
    paint();
  } catch (error) {
    if (error.name !== "AbortError") await safely(() => { throw error; });
  }
  drawing = null;
  document.body.dataset.drawn = number === wanted && longest >= MOST_PX ? "full" : "moving";
  if (number !== wanted) draw(movingPx, 70);
  else if (longest < MOST_PX) stillTimer = setTimeout(() => { if (!drawing) draw(MOST_PX, 92); }, STILL_MS);
}

// Depth in metres under a pixel of the page; 0: nothing there.
export function depthAt(x, y) {
  if (!shown) return 0;
  const column = Math.floor(x / shown.camera.width * shown.columns), line = Math.floor(y / shown.camera.height * shown.rows);
  return column >= 0 && line >= 0 && column < shown.columns && line < shown.rows ? shown.depth[line * shown.columns + column] : 0;
}
export function placeUnder(x, y) {
  const depth = depthAt(x, y);
  return depth > 0 ? placeAt(shown.camera, x, y, depth) : null;
}

const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
export const inView = (inGeo) => minus(inGeo, scene.middle_in_geo);

// Draws all that lies over the picture, with the picture's own camera.
export function paint() {
  if (!shown) return;
  written.length = 0;
  const { clientWidth: width, clientHeight: height } = overlay, ratio = devicePixelRatio;
  if (overlay.width !== Math.round(width * ratio)) Object.assign(overlay, { width: Math.round(width * ratio), height: Math.round(height * ratio) });
  if (overlay.height !== Math.round(height * ratio)) overlay.height = Math.round(height * ratio);
  const context = overlay.getContext("2d");
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  const seen = shown.camera;
  const pixelOf = (place) => {
    const pixel = project(seen, place);
    if (pixel.z <= 0) return null;
    const before = depthAt(pixel.x, pixel.y);
    return { ...pixel, hidden: before > 0 && pixel.z > before * 1.015 + 0.05 };
  };
  if (state.photo === null) drawOverlays(context, pixelOf);
  for (const layer of layers) layer(context, pixelOf, seen);
  drawScale(seen);
  byId("needle").setAttribute("transform", `rotate(${-headingOf(seen)})`);
  const legend = byId("legend");
  legend.hidden = !shown.scale;
  if (shown.scale) {
    const unit = { height: "m", sigma: "m", views: "" }[shown.colouring] ?? "", digits = { views: 0, sigma: 3 }[shown.colouring] ?? 1;
    const up = shown.colouring === "height" ? scene.crs.middle[2] - scene.middle_in_geo[2] : 0;
    byId("legend-name").textContent = { height: "height", sigma: "predicted σ", views: "photographs that see it" }[shown.colouring] ?? "";
    [byId("legend-low").textContent, byId("legend-high").textContent] = shown.scale.map((value) => `${(value + up).toFixed(digits)} ${unit}`);
  }
}

function headingOf({ rotation }) {
  const forward = row(rotation, 2), up = row(rotation, 1).map((value) => -value);
  const along = Math.abs(forward[2]) > 0.99 ? up : forward;
  return Math.atan2(along[0], along[1]) * 180 / Math.PI;
}

function line(context, pixelOf, places, closed = false) {
  const pixels = places.map(pixelOf);
  const count = closed ? pixels.length : pixels.length - 1;
  for (let k = 0; k < count; k += 1) {
    const [a, b] = [pixels[k], pixels[(k + 1) % pixels.length]];
    if (!a || !b) continue;
    context.globalAlpha = a.hidden && b.hidden ? 0.25 : 1;
    context.beginPath(); context.moveTo(a.x, a.y); context.lineTo(b.x, b.y); context.stroke();
  }
  context.globalAlpha = 1;
}
export const drawLine = line;

const written = [];  // boxes of the names of this picture
// Writes a text; a name gives way where another text stands.
export function label(context, text, x, y, colour = css("--ink"), { givesWay = false } = {}) {
  context.font = "12px system-ui, sans-serif";
  const box = [x - 2, y - 12, x + context.measureText(text).width + 2, y + 3];
  if (givesWay && written.some(([l, t, r, b]) => box[0] < r && box[2] > l && box[1] < b && box[3] > t)) return;
  written.push(box);
  context.lineWidth = 3; context.strokeStyle = css("--paper"); context.strokeText(text, x, y);
  context.fillStyle = colour; context.fillText(text, x, y);
}

function drawOverlays(context, pixelOf) {
  const on = (name) => state.shown.has(name);
  if (on("tie points")) {
    const { at, rgb, sigma } = scene.tie_points, colour = on("points by σ") && sigma ? sigma.rgb : rgb;
    for (let k = 0; k < at.length; k += 3) {
      const pixel = pixelOf([at[k], at[k + 1], at[k + 2]]);
      if (!pixel) continue;
      context.fillStyle = `rgb(${colour[k]} ${colour[k + 1]} ${colour[k + 2]})`;
      context.fillRect(pixel.x - 1, pixel.y - 1, 2, 2);
    }
  }
  context.lineWidth = 1.5;
  if (on("boundary")) { context.strokeStyle = css("--chosen"); for (const ring of scene.boundary) line(context, pixelOf, ring); }
  if (on("contours")) for (const { at, major } of scene.contours) { context.strokeStyle = css("--ink"); context.lineWidth = major ? 1.6 : 0.7; line(context, pixelOf, at); }
  if (on("changes")) for (const { at, text, raised, doubtful } of scene.changes) {
    context.strokeStyle = css(raised ? "--main" : "--alarm"); context.lineWidth = 2;
    context.setLineDash(doubtful ? [6, 4] : []);
    line(context, pixelOf, at);
    context.setLineDash([]);
    const pixel = text && pixelOf(at[0]);
    if (pixel) label(context, text, pixel.x + 6, pixel.y - 4, css(raised ? "--main" : "--alarm"));
  }
  if (on("cameras")) for (const each of scene.cameras) drawCamera(context, pixelOf, each);
  if (on("errors") && scene.errors) {
    context.strokeStyle = css("--alarm"); context.lineWidth = 2;
    for (const arrow of scene.errors.arrows) {
      line(context, pixelOf, arrow);
      const tip = pixelOf(arrow[1]);
      if (tip) { context.fillStyle = css("--alarm"); context.beginPath(); context.arc(tip.x, tip.y, 3, 0, 7); context.fill(); }
    }
  }
  if (on("points")) for (const { at, name, kind } of scene.surveyed) {
    const pixel = pixelOf(at);
    if (!pixel) continue;
    context.globalAlpha = pixel.hidden ? 0.4 : 1;
    context.fillStyle = kind === "control" ? css("--chosen") : css("--ink");
    context.beginPath(); context.arc(pixel.x, pixel.y, 5, 0, 7); context.fill();
    context.strokeStyle = css("--paper"); context.lineWidth = 1.5; context.stroke();
    label(context, name, pixel.x + 8, pixel.y + 4, css("--ink"), { givesWay: true });
    context.globalAlpha = 1;
  }
}

function drawCamera(context, pixelOf, { at, rotation, half, split }) {
  const middle = pixelOf(at);
  if (!middle) return;
  context.strokeStyle = split === "train" ? css("--main") : css("--chosen");
  context.lineWidth = 1.2;
  if (scene.cameras.length > 400) { context.strokeRect(middle.x - 2, middle.y - 2, 4, 4); return; }
  const size = 0.035 * scene.radius_m;
  const corners = [[-1, -1], [1, -1], [1, 1], [-1, 1]].map(([x, y]) =>
    [x * half[0], y * half[1], 1].reduce((sum, value, k) => add(sum, row(rotation, k), size * value), at));
  const pixels = corners.map(pixelOf);
  if (pixels.some((pixel) => !pixel)) return;
  context.beginPath();
  pixels.forEach((pixel, k) => { const following = pixels[(k + 1) % 4]; context.moveTo(pixel.x, pixel.y); context.lineTo(following.x, following.y); context.moveTo(middle.x, middle.y); context.lineTo(pixel.x, pixel.y); });
  context.stroke();
}

function drawScale(seen) {
  const depth = depthAt(seen.width / 2, seen.height / 2) || state.view.distance, metre = focal(seen) / depth;
  const length = rounded(120 / metre);
  byId("scale-text").textContent = length >= 1 ? `${length} m` : `${Math.round(length * 100)} cm`;
  byId("scale-bar").style.width = `${length * metre}px`;
}

// Pixel of a place in the last picture; null: behind the camera.
export function pixelOn(place) {
  const pixel = shown ? project(shown.camera, place) : null;
  return pixel && pixel.z > 0 ? pixel : null;
}

// The overlay under a pixel: a camera or a surveyed point; null: none.
export function overlayAt(x, y) {
  if (!shown || state.photo !== null) return null;
  let best = null;
  const near = (at, found) => {
    const pixel = project(shown.camera, at), off = Math.hypot(pixel.x - x, pixel.y - y);
    if (pixel.z > 0 && off < SNAP_PX && (!best || pixel.z < best.z)) best = { z: pixel.z, ...found };
  };
  if (state.shown.has("points")) scene.surveyed.forEach(({ at, name }) => near(at, { point: name }));
  if (state.shown.has("cameras")) scene.cameras.forEach(({ at }, index) => near(at, { camera: index }));
  return best;
}

// Body of a request about a pixel of the page.
export const pixelRequest = (x, y) => { const { rotation, position, fov, width, height } = shown.camera; return { rotation, position, fov, width, height, x, y }; };

// Mouse and fingers. A drag turns around the place under the pointer's first touch; two fingers move and zoom.
const pointers = new Map();
let moved = 0, last = null, held = null, clicked = { time: -Infinity };
function pointerAt(event) { const box = overlay.getBoundingClientRect(); return { x: event.clientX - box.left, y: event.clientY - box.top }; }

function leavePhotograph() {
  if (state.photo === null) return;
  const of = scene.cameras[state.photo], forward = row(of.rotation, 2);
  const middle = placeUnder(overlay.clientWidth / 2, overlay.clientHeight / 2);
  const distance = middle ? norm(minus(middle, of.at)) : scene.radius_m;
  const pitch = Math.asin(Math.min(Math.max(-forward[2], -1), 1)) * 180 / Math.PI;
  change({ photo: null, view: { target: add(of.at, forward, distance), distance, heading: headingOf(of), pitch, fov: state.view.fov } }, { step: true });
}
export { leavePhotograph };

export function turn(heading, pitch) {
  leavePhotograph();
  const view = inPerspective(state.view);
  change({ view: { ...view, heading: (view.heading + heading + 540) % 360 - 180, pitch: Math.min(Math.max(view.pitch + pitch, -89.9), 90) } });
}
export function pan(dx, dy) {
  leavePhotograph();
  const seen = orbit(state.view, overlay.clientWidth, overlay.clientHeight), metre = state.view.distance / focal(seen);
  const target = add(add(state.view.target, row(seen.rotation, 0), -dx * metre), row(seen.rotation, 1), -dy * metre);
  change({ view: { ...state.view, target } });
}
export function zoom(factor, x, y) {
  leavePhotograph();
  const { view } = state, place = x === undefined ? null : placeUnder(x, y);
  const distance = Math.min(Math.max(view.distance * factor, 0.002 * scene.radius_m), 40 * scene.radius_m * WIDE / view.fov);
  const toward = place && factor < 1 ? 1 - distance / view.distance : 0;
  change({ view: { ...view, distance, target: toward ? add(view.target, minus(place, view.target), toward) : view.target } });
}
// Metres from the middle of the view to its upper edge.
export const halfSeen = () => state.view.distance * Math.tan(state.view.fov / 2);
// Looks at a place, from a distance of the usual lens if one is given.
export function lookAt(place, distance) {
  leavePhotograph();
  const { view } = state;
  change({ view: { ...view, target: place, distance: distance === undefined ? view.distance : away(distance * Math.tan(WIDE / 2), view.fov) } }, { step: true });
}

export function listen() {
  overlay.addEventListener("pointerdown", (event) => {
    overlay.setPointerCapture(event.pointerId); overlay.focus({ preventScroll: true });
    pointers.set(event.pointerId, pointerAt(event)); moved = pointers.size > 1 ? CLICK_PX : 0; last = pointerAt(event);
    held = pointers.size === 1 && event.button === 0 && !event.shiftKey ? grips[state.tab]?.(last) ?? null : null;
  });
  overlay.addEventListener("pointermove", (event) => {
    const at = pointerAt(event), before = pointers.get(event.pointerId);
    if (!before) { hover(at); return; }
    pointers.set(event.pointerId, at);
    moved += Math.hypot(at.x - last.x, at.y - last.y); last = at;
    if (moved < CLICK_PX) return;
    if (held) { held.move(at); return; }
    const [dx, dy] = [at.x - before.x, at.y - before.y];
    if (pointers.size === 2) {
      const other = [...pointers].find(([id]) => id !== event.pointerId)[1];
      zoom(Math.hypot(before.x - other.x, before.y - other.y) / Math.max(Math.hypot(at.x - other.x, at.y - other.y), 1));
      pan(dx / 2, dy / 2);
    } else if (event.buttons & 6 || event.shiftKey) pan(dx, dy);
    else turn(-0.3 * dx, 0.3 * dy);
  });
  const released = (event) => {
    const wasClick = pointers.has(event.pointerId) && moved < CLICK_PX && event.type === "pointerup" && event.button === 0;
    pointers.delete(event.pointerId);
    if (held && moved >= CLICK_PX && event.type === "pointerup") held.drop(pointerAt(event));
    held = null;
    if (!wasClick) return;
    const at = pointerAt(event), second = event.timeStamp - clicked.time < DOUBLE_MS && Math.hypot(at.x - clicked.x, at.y - clicked.y) < CLICK_PX;
    clicked = second ? { time: -Infinity } : { time: event.timeStamp, ...at };
    clicks[state.tab]?.(at, second);
  };
  overlay.addEventListener("pointerup", released);
  overlay.addEventListener("pointercancel", released);
  overlay.addEventListener("contextmenu", (event) => event.preventDefault());
  overlay.addEventListener("wheel", (event) => { event.preventDefault(); const at = pointerAt(event); zoom(Math.exp(0.0012 * event.deltaY), at.x, at.y); }, { passive: false });
  overlay.addEventListener("pointerleave", () => { byId("cursor").textContent = ""; hovers[state.tab]?.(null); });
  new ResizeObserver(() => look()).observe(overlay);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => look());
  let before = "";
  onState(() => {  // what the picture does not show asks for none
    const { view, photo, share, colouring, box, light } = state, wants = JSON.stringify([view, photo, share, colouring, box, light]);
    if (scene && wants !== before) look();
    before = wants;
  });
}

// Coordinates under the cursor, in the CRS; they are exact to a pixel of the small depth.
function hover({ x, y }) {
  hovers[state.tab]?.({ x, y });
  const place = placeUnder(x, y), output = byId("cursor");
  if (!place) { output.textContent = ""; return; }
  const { crs } = scene, decimals = crs.axes[0] === "longitude" ? [7, 7, 2] : [2, 2, 2];
  const values = crs.middle.map((middle, k) => middle + crs.by_view[k].reduce((sum, by, j) => sum + by * place[j], 0));
  output.textContent = [...crs.axes, "height"].map((name, k) => `${name} ${values[k].toFixed(decimals[k])}`).join("  ");
}
