// The tab Mark: points in photographs, beside their neighbours with epipolar lines, and proposals for further marks.

import { sensible } from "./geometry.js";
import { byId, change, crop, cross, did, element, get, notice, onState, post, question, safely, state, undo } from "./base.js";
import { addPoint } from "./measure.js";
import { leavePhotograph, scene } from "./scene.js";

const sheet = byId("sheet"), NEIGHBOURS = 6, CLOSER = 2;  // screen pixels of a photograph's pixel, after a click that comes closer
let known = { points: [], is_written: true }, photographs = [], lines = [];
let image = null, of = null, at = { x: 0, y: 0, scale: 0 };  // photograph shown, and the pixel in the middle of the sheet
const colours = { mark: "#ff5a1f", expected: "#1fa0ff", line: "#ffd000" };
const chosen = () => known.points.find(({ name }) => name === state.point) ?? null;
const shownPhoto = () => photographs.find(({ camera }) => camera === state.photo) ?? null;

let alterations = 0;
function alter(path, body) { alterations += 1; return post(path, body); }

async function take(points) {
  known = points;
  const names = known.points.map(({ name }) => name);
  byId("points").replaceChildren(...(names.length ? names : ["—"]).map((name) => element("option", { value: name }, name)));
  if (!names.includes(state.point)) change({ point: names[0] ?? "" });
  byId("points").value = state.point || "—";
  await follow();
}

// Reads where the chosen point must appear, and shows it.
async function follow() {
  const point = chosen();
  photographs = point ? (await safely(() => get(`points/photographs?name=${encodeURIComponent(point.name)}`))) ?? [] : [];
  lines = point && state.photo !== null ? (await safely(() => get(`points/lines?name=${encodeURIComponent(point.name)}&camera=${state.photo}`))) ?? [] : [];
  render();
  drawSheet();
}

function render() {
  const point = chosen();
  byId("mark-hint").textContent = point ? (state.photo === null ? "Next shows the nearest photograph in which the point must appear." : `Shown: ${scene.cameras[state.photo].name}. ${known.is_written ? "" : "Changes are kept; gcp_list.txt is not written yet."}`) : "Make a point below: its name, and its coordinates if it was surveyed.";
  const rows = [];
  if (point?.xyz || point?.triangulated) rows.push(element("tr", {}, element("th"), ...[...scene.crs.axes, "height"].map((name) => element("th", {}, name))));
  if (point?.xyz) rows.push(element("tr", {}, element("th", {}, "surveyed"), ...point.xyz.map((v) => element("td", {}, v.toFixed(3)))));
  if (point?.triangulated) rows.push(element("tr", { "data-triangulated": point.place_in_geo.join(",") }, element("th", {}, "by marks"), ...point.triangulated.map((v, k) => element("td", {}, sensible(v, point.sigma_m?.[k])))));
  if (point?.triangulated && point.sigma_m) rows.push(element("tr", {}, element("th", {}, "± m"), ...point.sigma_m.map((v) => element("td", {}, sensible(v, v)))));
  const marks = (point?.marks ?? []).map(({ image: name, px, residual_px: off, wrong }) => element("tr", { "data-mark": name, "data-px": px.join(","), class: wrong ? "wrong" : false, title: wrong ? "Disagrees with the other marks of the point" : false },
    element("th", {}, wrong ? `⚠ ${name}` : name), element("td", {}, px[0].toFixed(2)), element("td", {}, px[1].toFixed(2)), element("td", {}, off === null || off === undefined ? "" : `${off.toFixed(2)} px`),
    element("td", {}, element("button", { "aria-label": `Remove the mark in ${name}`, onclick: () => setMark(name, null) }, "×"))));
  byId("marks").replaceChildren(...(rows.length ? [element("table", {}, ...rows)] : []), ...(marks.length ? [element("table", {}, element("tr", {}, ...["mark in", "x", "y", "residual", ""].map((text) => element("th", {}, text))), ...marks)] : []));
  byId("neighbours").replaceChildren(...photographs.filter(({ camera, px }) => camera !== state.photo && px).slice(0, NEIGHBOURS).map((each) => {
    const middle = each.mark ?? each.px;
    return element("figure", {}, element("button", { onclick: () => open(each.camera), "aria-label": `Show ${each.image}` }, crop(each.camera, middle, 40, (context, pixel) => {
      if (each.mark) cross(context, each.mark, 8 * pixel, colours.mark, true);
      cross(context, each.px, 8 * pixel, colours.expected);
      neighbourLines(each, context);
    })), element("figcaption", { title: each.image }, `${each.mark ? "✓ " : ""}${each.image}`));
  }));
}

async function neighbourLines(each, context) {
  const point = chosen();
  const found = point ? await get(`points/lines?name=${encodeURIComponent(point.name)}&camera=${each.camera}`).catch(() => []) : [];
  for (const line of found) drawPath(context, line.px);
}
function drawPath(context, places) {
  context.strokeStyle = colours.line;
  context.beginPath();
  places.forEach(([x, y], k) => (k ? context.lineTo(x, y) : context.moveTo(x, y)));
  context.stroke();
}

// Shows a photograph, close to where the point must be if it was close before.
export function open(camera) { change({ photo: camera }, { step: true }); }

function load() {
  const open = state.tab === "mark" && state.photo !== null && state.photo < scene.cameras.length;
  byId("photo").hidden = !open;
  if (!open) return;
  if (of === state.photo) { drawSheet(); return; }
  of = state.photo; image = null;
  const wanted = new Image();
  wanted.addEventListener("load", () => { if (of === state.photo) { image = wanted; whole(); } });
  wanted.addEventListener("error", () => safely(() => get(`photo/${state.photo}?px=16`)));
  wanted.src = `photo/${of}?px=8192`;
  follow();
}

const fit = () => { const [w, h] = scene.cameras[state.photo].size; return Math.min(sheet.clientWidth / w, (sheet.clientHeight - (byId("neighbours").childElementCount ? 175 : 0)) / h); };
export function whole() {
  if (state.photo === null) return;
  const [w, h] = scene.cameras[state.photo].size, scale = fit();
  at = { x: w / 2, y: h / 2 + (byId("neighbours").childElementCount ? 87 / scale : 0), scale };
  drawSheet();
}
function drawSheet() {
  if (byId("photo").hidden || !image) return;
  const ratio = devicePixelRatio, [width, height] = [sheet.clientWidth, sheet.clientHeight];
  Object.assign(sheet, { width: width * ratio, height: height * ratio });
  const context = sheet.getContext("2d"), scale = at.scale * ratio;
  context.setTransform(scale, 0, 0, scale, width * ratio / 2 - at.x * scale, height * ratio / 2 - at.y * scale);
  context.imageSmoothingEnabled = at.scale < 3;
  const [w, h] = scene.cameras[state.photo].size;
  context.drawImage(image, 0, 0, w, h);
  const pixel = 1 / at.scale;
  context.lineWidth = 1.5 * pixel;
  for (const line of lines) drawPath(context, line.px);
  context.lineWidth = 2 * pixel;
  const shown = shownPhoto();
  if (shown?.px) cross(context, shown.px, 12 * pixel, colours.expected);
  if (shown?.mark) cross(context, shown.mark, 9 * pixel, colours.mark, true);
  document.body.dataset.sheet = `${of}`;
}
const toPhoto = (event) => {
  const box = sheet.getBoundingClientRect();
  return [at.x + (event.clientX - box.left - sheet.clientWidth / 2) / at.scale, at.y + (event.clientY - box.top - sheet.clientHeight / 2) / at.scale];
};
const zoomSheet = (factor, [x, y]) => { const scale = Math.min(Math.max(at.scale * factor, fit() / 2), 40), by = at.scale / scale; at = { x: x + (at.x - x) * by, y: y + (at.y - y) * by, scale }; drawSheet(); };

async function setMark(name, place, quietly = false) {
  const point = chosen();
  if (!point) return;
  const former = point.marks.find(({ image: own }) => own === name)?.px ?? null, body = (px) => ({ point: point.name, image: name, place_px: px });
  await safely(async () => {
    const points = await alter("marks", body(place));
    did("mark", `${place ? "mark" : "removal of the mark"} of ${point.name} in ${name}`, async () => take(await alter("marks", body(former))));
    await take(points);
    const made = chosen()?.marks.find(({ image: own }) => own === name);
    if (made?.wrong && !quietly) notice(`The mark in ${name} disagrees with the others by ${made.residual_px.toFixed(0)} px.`, { failed: true });
  });
}

export function turnTo(step) {
  if (!chosen() || !photographs.length) return;
  const place = photographs.findIndex(({ camera }) => camera === state.photo);
  open(photographs[place < 0 ? 0 : (place + step + photographs.length) % photographs.length].camera);
}

async function propose() {
  const point = chosen();
  if (!point) return;
  await safely(async () => {
    let job = await post("proposals", { point: point.name });
    const seen = new Set(), holder = byId("proposals");
    holder.replaceChildren(element("p", { class: "note" }, "Searching …"));
    while (true) {
      for (const each of job.answer ?? []) if (!seen.has(each.image)) { seen.add(each.image); holder.append(proposal(point, each)); }
      if (job.state !== "running") break;
      await new Promise((done) => setTimeout(done, 200));
      job = { ...(await get(`jobs/${job.number}`)), number: job.number };
    }
    if (job.state === "failed") throw new Error(job.failure);
    holder.firstChild.textContent = seen.size ? `${seen.size} proposed. Accept or refuse each.` : "No photograph shows the same with certainty.";
    if (seen.size > 1) holder.firstChild.append(" ", element("button", { onclick: async () => { for (const button of holder.querySelectorAll("[data-accept]")) await button.accept(); } }, "Accept all"));
  }).catch(() => {});
}
function proposal(point, each) {
  const line = element("div", { class: "proposal", "data-proposed": each.image });
  const accept = element("button", { class: "main", "data-accept": true }, "Accept");
  accept.accept = async () => { line.remove(); if (state.point === point.name) await setMark(each.image, each.place_px); };
  accept.addEventListener("click", accept.accept);
  line.append(crop(each.camera, each.place_px, 22, (context, pixel) => cross(context, each.place_px, 8 * pixel, colours.mark, true)),
    element("div", {}, element("div", {}, each.image), element("div", { class: "note" }, `correlation ${each.score.toFixed(2)}`), element("div", { class: "row" }, accept, element("button", { onclick: () => line.remove() }, "Refuse"))));
  return line;
}

async function write() {
  const wrong = known.points.flatMap(({ name, marks }) => marks.filter((mark) => mark.wrong).map((mark) => `${mark.image} of ${name} (${mark.residual_px.toFixed(0)} px)`));
  if (wrong.length && !(await question(`These marks disagree with the others of their point: ${wrong.join(", ")}. Write all the same?`))) return;
  await safely(async () => {
    const before = alterations;
    const { files, heights } = await post("points/write", {});
    byId("written").textContent = `Written: ${files.join(", ")}. Heights: ${heights}.`;
    const points = await get("points");
    if (alterations === before) await take(points);  // else the answer to a later change tells more
  });
}

async function setPoint(event) {
  event.preventDefault();
  const name = byId("point-name").value.trim(), texts = byId("point-xyz").value.replaceAll(",", " ").split(/\s+/).filter(Boolean), xyz = texts.map(Number);
  if (!name) { notice("A point needs a name.", { failed: true }); return; }
  if (texts.length && (xyz.length !== 3 || !xyz.every(Number.isFinite))) { notice(`Coordinates are three numbers: ${scene.crs.axes.join(", ")}, height in ${scene.crs.name}.`, { failed: true }); return; }
  await safely(async () => {
    const fresh = !known.points.some((point) => point.name === name);
    const points = await alter("points", { name, xyz: texts.length ? xyz : null, is_check: byId("point-check").checked });
    if (fresh) did("mark", `point ${name}`, async () => take(await alter("points/remove", { name })));
    change({ point: name });
    await take(points);
  });
}

export async function begin() {
  let drag = null;
  sheet.addEventListener("pointerdown", (event) => { sheet.setPointerCapture(event.pointerId); sheet.focus({ preventScroll: true }); drag = { x: event.clientX, y: event.clientY, moved: 0, from: at }; });
  sheet.addEventListener("pointermove", (event) => {
    if (!drag) return;
    const [dx, dy] = [event.clientX - drag.x, event.clientY - drag.y];
    drag.moved = Math.max(drag.moved, Math.hypot(dx, dy));
    if (drag.moved > 4) { at = { ...drag.from, x: drag.from.x - dx / at.scale, y: drag.from.y - dy / at.scale }; drawSheet(); }
  });
  sheet.addEventListener("pointerup", (event) => {
    const click = drag && drag.moved <= 4 && event.button === 0;
    drag = null;
    if (!click || !image) return;
    const place = toPhoto(event);
    if (at.scale < Math.min(CLOSER, fit() * 4) * 0.99) zoomSheet(Math.max(CLOSER / at.scale, 3), place);
    else if (chosen()) setMark(scene.cameras[state.photo].name, place);
    else notice("Make a point first.");
  });
  sheet.addEventListener("wheel", (event) => { event.preventDefault(); zoomSheet(Math.exp(-0.0012 * event.deltaY), toPhoto(event)); }, { passive: false });
  new ResizeObserver(() => drawSheet()).observe(sheet);
  byId("points").addEventListener("change", () => { change({ point: byId("points").value }); byId("proposals").replaceChildren(); follow(); });
  byId("next").onclick = () => turnTo(1);
  byId("previous").onclick = () => turnTo(-1);
  byId("whole").onclick = whole;
  byId("propose").onclick = propose;
  byId("mark-back").onclick = () => safely(() => undo("mark"));
  byId("write").onclick = write;
  byId("point").addEventListener("submit", setPoint);
  byId("point-remove").onclick = () => safely(async () => {
    const point = chosen();
    if (!point) return;
    const points = await alter("points/remove", { name: point.name });
    did("mark", `removal of ${point.name}`, async () => {
      await alter("points", { name: point.name, xyz: point.xyz, is_check: point.is_check });
      for (const { image: name, px } of point.marks) await alter("marks", { point: point.name, image: name, place_px: px });
      change({ point: point.name });
      await take(await get("points"));
    });
    await take(points);
  });
  byId("measure-marked").onclick = () => safely(async () => {
    const point = chosen();
    if (!point) return;
    const found = await get(`points/place?name=${encodeURIComponent(point.name)}`);
    if (found.reason) throw new Error(found.reason);
    leavePhotograph();
    change({ tab: "measure" }, { step: true });
    addPoint(found, point.name);
  });
  await safely(async () => take(await get("points")));
  let before = "";
  onState(() => { const mark = `${state.tab} ${state.photo} ${state.point}`; if (mark !== before) { before = mark; load(); if (state.tab === "mark") { byId("points").value = state.point || "—"; render(); } } });
  load();
}
