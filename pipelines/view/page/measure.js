// The tab Measure: points under clicks, their quantities with σ, profiles, and what is saved.

import { minus, norm, rounded, sensible, withSigma } from "./geometry.js";
import { ask, byId, change, did, element, get, notice, onState, post, redo, safely, state, undo } from "./base.js";
import { clicks, drawLine, grips, hovers, inView, label, layers, lookAt, overlayAt, paint, pixelOn, pixelRequest, placeUnder, scene } from "./scene.js";

const KINDS = { point: [1, 1], distance: [2, 2], polyline: [2, 1000], profile: [2, 1000], area: [3, 1000], volume: [3, 1000] };
const CLOSED = new Set(["area", "volume"]);
const KEPT = "georef measurement";
const now = { points: [], closed: false, job: null, answer: null };  // the measurement in progress
let saved = [], picking = Promise.resolve(), showing = null;

const keep = () => sessionStorage.setItem(KEPT, JSON.stringify({ kind: state.kind, points: now.points, closed: now.closed, base: base() }));

export function base() {
  const kind = byId("base-kind").value;
  return kind.endsWith(".tif") ? { kind: "raster", raster: kind } : { kind, height: kind === "height" ? Number(byId("base-height").value) || 0 : 0 };
}

// Sets the points of the measurement in progress, and computes what is finished.
function set(points, closed) {
  stop();
  const [least, most] = KINDS[state.kind];
  Object.assign(now, { points, closed: (closed || most === points.length) && points.length >= least, job: null, answer: null });
  keep();
  if (now.closed) compute();
  render();
  paint();
}

export function step(name, points, closed = false) {
  const before = { kind: state.kind, points: now.points, closed: now.closed };
  const after = { kind: state.kind, points, closed };
  const back = (to) => { change({ kind: to.kind }); set(to.points, to.closed); };
  did("measure", name, () => back(before), () => { step(name, after.points, after.closed); });
  set(points, closed);
}

export function addPoint(found, name = "") {
  if (found.reason) { notice(`Nothing measured: ${found.reason}.`, { failed: true }); return; }
  warnOutside(found);
  const most = KINDS[state.kind][1], kept = now.closed || now.points.length >= most ? [] : now.points;
  step(`point ${kept.length + 1}`, [...kept, { ...found, name }]);
}

// Outside the area of interest, few photographs see a place.
function warnOutside({ point }) {
  const [x, y] = inView(point.position_in_geo);
  const inside = scene.boundary.reduce((odd, ring) => ring.reduce((now_, [ax, ay], k) => {
    const [bx, by] = ring[(k + 1) % ring.length];
    return (ay > y) !== (by > y) && x < (bx - ax) * (y - ay) / (by - ay) + ax ? !now_ : now_;
  }, odd), false);
  if (scene.boundary.length && !inside) notice("This point is outside the area of interest: few photographs see it, and its height is less certain than its σ says.");
}

// A measured point under the pointer is dragged to another place of the surface.
let dragged = null, cursor = null;
grips.measure = ({ x, y }) => {
  const index = now.points.findIndex(({ point }) => { const at = pixelOn(inView(point.position_in_geo)); return at && Math.hypot(at.x - x, at.y - y) < 10; });
  if (index < 0) return null;
  return {
    move: (at) => { dragged = { index, place: placeUnder(at.x, at.y) }; paint(); },
    drop: (at) => {
      const request = pixelRequest(at.x, at.y), { points, closed } = now;
      dragged = null;
      picking = picking.then(() => safely(async () => {
        const found = await post("pick", request);
        if (found.reason) { notice(`The point stays: ${found.reason}.`, { failed: true }); paint(); return; }
        warnOutside(found);
        step(`moving of point ${index + 1}`, points.map((each, k) => (k === index ? { ...found, name: "" } : each)), closed);
      }));
    },
  };
};
hovers.measure = (at) => {
  cursor = at && now.points.length && !now.closed && KINDS[state.kind][1] > 1 ? placeUnder(at.x, at.y) : null;
  if (cursor || now.points.length) paint();
};

async function compute() {
  const points = now.points.map(({ point }) => point);
  await safely(async () => {
    let job = await post("jobs", { kind: state.kind, points, ...(state.kind === "volume" ? { base: base() } : {}) });
    now.job = job;
    while (now.job?.number === job.number) {
      now.job = job;
      if (job.answer) now.answer = job.answer;
      render();
      if (job.state !== "running") break;
      await new Promise((done) => setTimeout(done, 120));
      job = await get(`jobs/${job.number}`);
      job.number ??= now.job?.number;
    }
    if (job.state === "failed") notice(job.failure, { failed: true });
  });
}

function stop() {
  if (now.job?.state === "running") ask(`jobs/${now.job.number}`, { method: "DELETE" }).catch(() => {});
  now.job = null;
}

// Finishes the outline, once all clicks before are answered.
export function finish() {
  picking = picking.then(() => {
    const least = KINDS[state.kind][0];
    if (now.closed) return;
    if (now.points.length < least) notice(`A ${state.kind} needs ${least} points.`);
    else step("finishing", now.points, true);
  });
}
export const clear = () => { if (now.points.length) step("clearing", []); };

clicks.measure = ({ x, y }, second) => {
  if (second) { finish(); return; }
  const hit = overlayAt(x, y);
  const request = pixelRequest(x, y);
  picking = picking.then(() => safely(async () => {
    addPoint(hit?.point ? await get(`surveyed?name=${encodeURIComponent(hit.point)}`) : await post("pick", request), hit?.point ?? "");
  }));
};

function placeTable() {
  const { crs } = scene, digits = crs.axes[0] === "longitude" ? [8, 8, 3] : [3, 3, 3];
  const rows = now.points.flatMap(({ point, xyz, sigma_m: sigma, name, surveyed }, k) => {
    const cells = (values) => values.map((value, j) => element("td", {}, value.toFixed(digits[j])));
    const row = element("tr", { "data-measured": point.position_in_geo.join(",") }, element("th", {}, name || `${k + 1}`), ...xyz.map((value, j) =>
      element("td", {}, digits[j] > 4 ? value.toFixed(digits[j]) : sensible(value, sigma?.[j]))));
    const more = surveyed ? [element("tr", {}, element("th", {}, "surveyed"), ...cells(surveyed))] : [];
    return [row, ...(sigma ? [element("tr", {}, element("th", {}, "± m"), ...sigma.map((value) => element("td", {}, sensible(value, value))))] : []), ...more];
  });
  const short = { metre: "m", degree: "°" };
  const heads = [...crs.axes, "height"].map((name, j) => element("th", {}, `${name} (${short[crs.units[j]] ?? crs.units[j]})`));
  return element("table", {}, element("tr", {}, element("th"), ...heads), ...rows);
}

function quantityTable(quantities) {
  return element("table", {}, ...quantities.map(({ name, value, sigma, unit }) => element("tr", {
    "data-quantity": name, "data-value": value, "data-sigma": sigma ?? false,
  }, element("th", {}, name), element("td", {}, withSigma(value, sigma, unit, unit.startsWith("%") ? 0 : 2)))));
}

let profileAt = null;  // place of the scene under the cursor in the profile

// Round values between two bounds.
function ticksOf(low, high, about) {
  const step = rounded(Math.max(high - low, 1e-9) / about) || 1, first = Math.ceil(low / step - 1e-9);
  return Array.from({ length: Math.max(Math.floor(high / step + 1e-9) - first + 1, 0) }, (_, k) => (first + k) * step);
}

// Place of the scene at a distance along the line, at the height of the profile.
function placeAlong(distance, height) {
  const plan = now.points.map(({ point }) => inView(point.position_in_geo));
  let left = distance;
  for (let k = 1; k < plan.length; k += 1) {
    const leg = Math.hypot(plan[k][0] - plan[k - 1][0], plan[k][1] - plan[k - 1][1]);
    if (left <= leg || k === plan.length - 1) {
      const share = leg ? Math.min(left / leg, 1) : 0;
      const [x, y] = [0, 1].map((j) => plan[k - 1][j] + share * (plan[k][j] - plan[k - 1][j]));
      return [x, y, (height - scene.crs.middle[2]) / scene.crs.by_view[2][2]];
    }
    left -= leg;
  }
  return null;
}

function profileDrawing({ along_m: along, height, sigma_m: sigma }) {
  const W = Math.max(byId("view").clientWidth - 32, 280), H = 190, left = 64, bottom = 34;
  const known = height.filter((value) => value !== null);
  if (!known.length) return element("p", { class: "note" }, "No surface was found along the line.");
  const reach = sigma.map((value) => value ?? 0);
  const low = Math.min(...height.map((value, k) => (value === null ? Infinity : value - reach[k]))), high = Math.max(...height.map((value, k) => (value === null ? -Infinity : value + reach[k])));
  const span = Math.max(high - low, 0.1), x = (value) => left + value / along.at(-1) * (W - left - 10), y = (value) => 8 + (high - value) / span * (H - bottom - 8);
  const runs = [];
  height.forEach((value, k) => { if (value !== null) { if (k && height[k - 1] !== null) runs.at(-1).push(k); else runs.push([k]); } });
  const path = (ks, values) => ks.map((k) => `${x(along[k]).toFixed(1)},${y(values(k)).toFixed(1)}`).join(" ");
  const parts = runs.map((ks) => `<polygon class="band" points="${path(ks, (k) => height[k] + reach[k])} ${path([...ks].reverse(), (k) => height[k] - reach[k])}"/><polyline class="line" points="${path(ks, (k) => height[k])}"/>`);
  const text = (value, step) => value.toFixed(Math.max(0, -Math.floor(Math.log10(step) + 1e-9)));
  const up = ticksOf(low, low + span, 4), across = ticksOf(0, along.at(-1), W > 600 ? 10 : 4);
  const [upStep, acrossStep] = [up, across].map((ticks) => (ticks.length > 1 ? ticks[1] - ticks[0] : 1));
  const ticks = [
    ...up.map((value) => `<line class="axis" x1="${left}" x2="${W - 10}" y1="${y(value)}" y2="${y(value)}"/><text x="${left - 6}" y="${y(value) + 4}" text-anchor="end">${text(value, upStep)}</text>`),
    ...across.map((value) => `<line class="axis" x1="${x(value)}" x2="${x(value)}" y1="8" y2="${H - bottom}"/><text class="along" x="${x(value)}" y="${H - bottom + 13}" text-anchor="middle">${text(value, acrossStep)}</text>`),
  ];
  const holder = element("div");
  holder.innerHTML = `<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 ${W} ${H}" role="img" aria-label="Profile with its σ band">${ticks.join("")}${parts.join("")}<text x="${W / 2}" y="${H - 3}" text-anchor="middle">distance along the line in m; height in ${scene.crs.units[2] === "metre" ? "m" : scene.crs.units[2]} with ± σ</text><text class="at" x="${W - 12}" y="18" text-anchor="end"></text></svg>`;
  const svg = holder.querySelector("svg");
  svg.addEventListener("pointermove", (event) => {
    const box = svg.getBoundingClientRect(), wanted = ((event.clientX - box.left) / box.width * W - left) / (W - left - 10) * along.at(-1);
    const k = along.reduce((best, value, each) => (height[each] !== null && Math.abs(value - wanted) < Math.abs(along[best] - wanted) ? each : best), height.findIndex((value) => value !== null));
    svg.querySelector(".at").textContent = `${along[k].toFixed(2)} m: ${withSigma(height[k], sigma[k], "", 2)}`;
    profileAt = placeAlong(along[k], height[k]);
    paint();
  });
  svg.addEventListener("pointerleave", () => { profileAt = null; svg.querySelector(".at").textContent = ""; paint(); });
  return holder;
}

const SVG_STYLE = ".band{fill:#0b5cad;opacity:.25}.line{fill:none;stroke:#16202b;stroke-width:1.3}text{font:10px sans-serif}.axis{stroke:#c6ced6}";
function download(name, text, type) {
  const link = element("a", { href: URL.createObjectURL(new Blob([text], { type })), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

export function render() {
  const { kind } = state, [least, most] = KINDS[kind], running = now.job?.state === "running";
  for (const input of byId("kinds").querySelectorAll("input")) input.checked = input.value === kind;
  byId("base").hidden = kind !== "volume";
  byId("base-height-label").hidden = byId("base-kind").value !== "height";
  byId("hint").textContent = now.closed ? "" : `Click in the scene, or on the sign of a surveyed point${most > 2 ? "; finish with Enter or a double click" : ""}. ${now.points.length ? `${now.points.length} of ${most > 2 ? `${least} or more` : most}.` : ""}`;
  byId("finish").disabled = now.closed || now.points.length < least;
  byId("clear").disabled = !now.points.length;
  byId("working").hidden = !running;
  byId("progress").value = now.job?.share ?? 0;
  byId("results").replaceChildren(...(now.answer?.quantities?.length ? [quantityTable(now.answer.quantities)] : []),
    ...(now.points.length ? [placeTable()] : []),
    ...(running && now.answer ? [element("p", { class: "note" }, "An estimate; it is being refined.")] : []),
    ...(now.points.length && scene.without_sigma ? [element("p", { class: "note" }, `No σ is stated: ${scene.without_sigma}.`)] : []));
  byId("results").dataset.state = now.job?.state ?? "";
  const profile = now.answer?.profile;
  byId("profile").hidden = !profile;
  byId("profile").replaceChildren();
  if (profile) {
    const drawn = profileDrawing(profile);
    const svg = () => drawn.querySelector("svg").outerHTML.replace(">", `><style>${SVG_STYLE}</style>`);
    byId("profile").append(drawn, element("div", { class: "row" }, element("button", { onclick: () => download("profile.svg", svg(), "image/svg+xml") }, "SVG"),
      ...["csv", "dxf"].map((form) => element("a", { href: `jobs/${now.job?.number}/${form}`, download: `profile.${form}`, role: "button", hidden: running }, form.toUpperCase()))));
  }
  byId("save").hidden = !(now.closed && now.job?.state === "done");
}

function renderSaved() {
  byId("saved").replaceChildren(...(saved.length ? saved.map((each) => {
    const values = each.quantities.slice(0, 3).map(({ name, value, sigma, unit }) => `${name} ${withSigma(value, sigma, unit, 2)}`).join("; ");
    return element("li", { "data-saved": each.name },
      element("strong", {}, each.name), ` ${each.kind}${each.older ? " (in an earlier model)" : ""}`, element("br"), element("span", { class: "note" }, values || each.points[0].xyz.map((v) => v.toFixed(3)).join(" ")),
      element("div", { class: "row" },
        element("button", { onclick: () => show(each) }, "Show"),
        element("button", { onclick: () => rename(each) }, "Rename"),
        element("button", { onclick: () => remove(each) }, "Delete")));
  }) : [element("li", { class: "note" }, "Nothing saved yet.")]));
  const files = saved.length ? ["measurements.geojson", "measurements.gpkg", ...new Set(saved.map(({ kind }) => ({ polyline: "polylines", distance: "distances" }[kind] ?? `${kind}s`) + ".csv"))] : [];
  byId("downloads").replaceChildren(...files.flatMap((name) => [element("a", { href: `saved/${name}`, download: name }, name), " "]));
}

const bare = ({ older: _older, cameras: _cameras, ...own }) => own;
async function remove(each) {
  await safely(async () => {
    saved = await post(`measurements/${each.id}`, undefined, "DELETE");
    did("measure", `deletion of ${each.name}`, async () => { saved = await post("measurements", bare(each), "PUT"); renderSaved(); paint(); });
    renderSaved(); paint();
  });
}
async function rename(each) {
  const name = prompt("New name", each.name)?.trim();
  if (name) await safely(async () => { saved = await post(`measurements/${each.id}`, { name }); renderSaved(); });
}
function show(each) {
  change({ shown: new Set([...state.shown, "saved"]) });
  const places = each.points.map((point) => inView(point.position_in_geo));
  const middle = [0, 1, 2].map((k) => places.reduce((sum, place) => sum + place[k], 0) / places.length);
  showing = each.id;
  lookAt(middle, Math.max(...places.map((place) => 3 * Math.hypot(...place.map((value, k) => value - middle[k]))), 0.15 * scene.radius_m));
}

layers.push((context, pixelOf) => {
  if (state.photo !== null) return;
  const style = getComputedStyle(document.documentElement), colour = style.getPropertyValue("--measure").trim();
  const draw = (points, closed, thick, names) => {
    context.strokeStyle = context.fillStyle = colour; context.lineWidth = thick;
    drawLine(context, pixelOf, points, closed);
    points.forEach((place, k) => {
      const pixel = pixelOf(place);
      if (!pixel) return;
      context.fillStyle = colour; context.beginPath(); context.arc(pixel.x, pixel.y, thick + 2, 0, 7); context.fill();
      if (names) label(context, names[k], pixel.x + 7, pixel.y - 6, colour);
    });
  };
  if (state.shown.has("saved")) for (const each of saved) draw(each.points.map((point) => inView(point.position_in_geo)), CLOSED.has(each.kind), each.id === showing ? 3 : 1.5, each.points.map((_, k) => (k ? "" : each.name)));
  const places = now.points.map(({ point }, k) => (dragged?.index === k && dragged.place) || inView(point.position_in_geo));
  const legs = places.slice(1).map((place, k) => [places[k], place]);
  if (cursor && places.length) {
    context.setLineDash([5, 4]);
    context.strokeStyle = colour; context.lineWidth = 1.5;
    drawLine(context, pixelOf, [places.at(-1), cursor]);
    context.setLineDash([]);
    legs.push([places.at(-1), cursor]);
  }
  if (state.kind !== "point") for (const [a, b] of legs) {
    const [p, q] = [pixelOf(a), pixelOf(b)];
    if (p && q && Math.hypot(p.x - q.x, p.y - q.y) > 40) label(context, `${norm(minus(b, a)).toFixed(2)} m`, (p.x + q.x) / 2 + 6, (p.y + q.y) / 2 - 4, colour);
  }
  if (profileAt) { const at = pixelOf(profileAt); if (at) { context.strokeStyle = colour; context.lineWidth = 2; context.beginPath(); context.arc(at.x, at.y, 7, 0, 7); context.stroke(); } }
  draw(places, CLOSED.has(state.kind) && (now.closed || now.points.length > 2), 2.5, now.points.map(({ name }, k) => name || `${k + 1}`));
});

export async function begin() {
  for (const kind of Object.keys(KINDS)) {
    byId("kinds").append(element("label", {}, element("input", { type: "radio", name: "kind", value: kind, onchange: () => chooseKind(kind) }), element("span", {}, kind)));
  }
  for (const name of scene.rasters) byId("base-kind").append(element("option", { value: name }, `raster/${name}`));
  byId("base-height").value = scene.crs.middle[2].toFixed(2);
  for (const name of ["base-kind", "base-height"]) byId(name).addEventListener("change", () => set(now.points, now.closed));
  byId("finish").onclick = finish;
  byId("back").onclick = () => safely(() => undo("measure"));
  byId("again").onclick = () => safely(() => redo("measure"));
  byId("clear").onclick = clear;
  byId("cancel").onclick = () => { stop(); render(); notice("Cancelled."); };
  byId("save").addEventListener("submit", (event) => {
    event.preventDefault();
    safely(async () => {
      const name = byId("save-name").value.trim() || `${state.kind} ${saved.length + 1}`, before = new Set(saved.map(({ id }) => id)), { points } = now;
      saved = await post("measurements", { job: now.job.number, name });
      const fresh = saved.find(({ id }) => !before.has(id));
      did("measure", `saving of ${name}`, async () => { saved = await post(`measurements/${fresh.id}`, undefined, "DELETE"); set(points, true); renderSaved(); });
      byId("save-name").value = "";
      change({ shown: new Set([...state.shown, "saved"]) });
      set([], false); renderSaved(); paint();
      notice(`Saved as ${name}, in view/ of the workspace.`);
    });
  });
  const kept = JSON.parse(sessionStorage.getItem(KEPT) ?? "null");
  if (kept && kept.kind === state.kind && Array.isArray(kept.points)) {
    if (kept.base) { byId("base-kind").value = kept.base.raster ?? kept.base.kind; if (kept.base.kind === "height") byId("base-height").value = kept.base.height; }
    set(kept.points, kept.closed);
  }
  saved = (await safely(() => get("measurements"))) ?? [];
  renderSaved(); render();
  let kind = state.kind;
  onState(() => { if (kind !== state.kind) { kind = state.kind; if (now.points.length > KINDS[kind][1]) set([], false); else render(); } });
}
function chooseKind(kind) {
  const before = state.kind, { points, closed } = now;
  did("measure", `choice of ${kind}`, () => { change({ kind: before }); set(points, closed); }, () => chooseKind(kind));
  change({ kind });
  set([], false);
}
