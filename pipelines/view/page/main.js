// The page: tabs, keys, what is shown, and the photographs that see a place.

import { byId, change, crop, cross, element, get, notice, onState, post, readState, redo, safely, state, undo } from "./base.js";
import { camera, clicks, fromAbove, halfSeen, home, inView, layers, leavePhotograph, listen, loadScene, look, lookAt, overlayAt, paint, pan, pixelRequest, placeUnder, scene, turn, zoom } from "./scene.js";
import * as measure from "./measure.js";
import * as mark from "./mark.js";

const OVERLAYS = { cameras: "cameras", points: "control and check points", errors: "their errors", "tie points": "SfM points", "points by σ": "SfM points by σ", boundary: "area of interest", contours: "contour lines", changes: "changed regions", saved: "saved measurements" };
const SIDES = ["west", "south", "low", "east", "north", "high"];
let place = null;  // whose photographs are shown

function showTab() {
  for (const name of ["see", "measure", "mark"]) {
    byId(name).hidden = state.tab !== name;
    byId(`tab-${name}`).setAttribute("aria-selected", state.tab === name);
    byId(`tab-${name}`).tabIndex = state.tab === name ? 0 : -1;
  }
  document.body.dataset.tab = state.tab;
}

function showState() {
  document.documentElement.style.colorScheme = state.light || "light dark";
  document.documentElement.dataset.light = state.light || (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light");
  showTab();
  byId("colouring").value = state.colouring;
  byId("share").value = state.share;
  byId("light").value = state.light;
  byId("photographs").value = state.photo ?? "";
  byId("leave").disabled = state.photo === null;
  byId("strip-on").checked = state.strip;
  byId("strip").hidden = !state.strip || !place || state.tab === "mark";
  byId("clip-on").checked = state.box !== null;
  for (const box of byId("overlays").querySelectorAll("input")) box.checked = state.shown.has(box.value);
  for (const input of byId("clip-sides").querySelectorAll("input")) if (document.activeElement !== input) input.value = (state.box ?? whole())[input.dataset.side].toFixed(1);
  paint();
}
const whole = () => { const r = scene.radius_m; return [-r, -r, -r, r, r, r]; };

const pixelSize = (m) => m < 1 ? `${(1000 * m).toFixed(0)} mm/px` : `${m.toFixed(2)} m/px`;

// Photographs that see a place, the best first.
async function showSeen(inGeo) {
  place = inGeo;
  if (!state.strip || !place) { showState(); return; }
  const seen = (await safely(() => post("seen", { position_in_geo: place }))) ?? [];
  byId("strip").replaceChildren(...seen.map((each) => element("figure", { "data-seen": each.image },
    element("button", { "aria-label": `Show ${each.image}`, onclick: () => change({ photo: each.camera }, { step: true }) }, crop(each.camera, each.px, 60, (context, pixel) => cross(context, each.px, 9 * pixel, "#ff5a1f"))),
    element("figcaption", { title: each.image }, `${pixelSize(each.gsd_m)}, ${each.angle_deg.toFixed(0)}° · ${each.image}`))));
  showState();
}

function inGeo(at) { return at.map((value, k) => value + scene.middle_in_geo[k]); }
clicks.see = ({ x, y }, second) => {
  const hit = overlayAt(x, y);
  if (hit?.camera !== undefined) { change({ photo: hit.camera }, { step: true }); return; }
  const found = placeUnder(x, y);
  if (second && found) { lookAt(found); return; }
  if (state.strip && found) showSeen(inGeo(found));
};
clicks.mark = () => mark.turnTo(1);
layers.push((context, pixelOf) => {
  if (!state.strip || !place) return;
  const pixel = pixelOf(inView(place));
  if (pixel) { context.lineWidth = 2; cross(context, [pixel.x, pixel.y], 9, "#ff5a1f"); }
});

const KEYS = [
  ["H", "whole scene", () => change({ photo: null, view: home() }, { step: true })],
  ["T", "from above, north up", () => { leavePhotograph(); change({ view: fromAbove(state.view) }, { step: true }); }],
  ["← → ↑ ↓", "turn; with Shift: move"],
  ["+ −", "closer, further"],
  ["1 2 3", "see, measure, mark"],
  ["Enter", "finish an outline (also: double click)", () => state.tab === "measure" && measure.finish()],
  ["Esc", "new measurement; leave the photograph", () => (state.photo !== null ? leave() : state.tab === "measure" && measure.clear())],
  ["Ctrl-Z", "undo; with Shift: do again"],
  ["Space", "measure or look at the middle of the scene"],
  ["N B", "next, previous photograph of a point; N elsewhere: north up", null],
  ["M", "whole photograph", () => mark.whole()],
  ["P", "fold or open the panel", () => fold()],
  ["?", "this list", () => byId("help").showModal()],
];
const leave = () => { leavePhotograph(); if (state.photo !== null) change({ photo: null }); };
function fold() { document.body.classList.toggle("folded"); byId("fold").setAttribute("aria-expanded", !document.body.classList.contains("folded")); }
const northUp = () => { leavePhotograph(); change({ view: { ...state.view, heading: 0 } }, { step: true }); };

function pressed(event) {
  if (event.target.closest("input:not([type=checkbox], [type=radio], [type=range]), textarea, dialog[open]")) return;
  if ((event.ctrlKey || event.metaKey) && event.key.toLowerCase() === "z") { event.preventDefault(); safely(() => (event.shiftKey ? redo() : undo())); return; }
  if (event.ctrlKey && event.key.toLowerCase() === "y") { event.preventDefault(); safely(() => redo()); return; }
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  const onControl = event.target.closest("button, select, a, input, summary");
  const arrows = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
  if (arrows && !onControl) { event.preventDefault(); if (event.shiftKey) pan(-40 * arrows[0], -40 * arrows[1]); else turn(6 * arrows[0], 4 * arrows[1]); return; }
  if (onControl && ["Enter", " "].includes(event.key)) return;
  if (event.key === " ") {
    event.preventDefault();
    const { width, height } = camera();
    clicks[state.tab]?.({ x: width / 2, y: height / 2 }, false);
    return;
  }
  const tab = { 1: "see", 2: "measure", 3: "mark" }[event.key];
  if (tab) { change({ tab }, { step: true }); return; }
  if (event.key === "+" || event.key === "=") zoom(0.8);
  else if (event.key === "-") zoom(1.25);
  else if (event.key.toLowerCase() === "n") (state.tab === "mark" ? mark.turnTo(1) : northUp());
  else if (event.key.toLowerCase() === "b") mark.turnTo(-1);
  else KEYS.find(([name, , act]) => act && name.toLowerCase() === { Escape: "esc", Enter: "enter" }[event.key] || act && name === event.key || act && name.toLowerCase() === event.key.toLowerCase())?.[2]();
}

function build() {
  byId("name").textContent = document.title = scene.name;
  byId("accuracy").textContent = [scene.accuracy, `Coordinates: ${scene.crs.name}; heights: ${scene.crs.heights}.`, ...scene.crs.assumed.filter(Boolean).map((text) => `Assumed: ${text}.`)].join(" ");
  for (const [name, title] of Object.entries(OVERLAYS)) {
    const nothing = { errors: !scene.errors, contours: !scene.contours.length, changes: !scene.changes.length, boundary: !scene.boundary.length, "points by σ": !scene.tie_points.sigma }[name];
    const text = name === "errors" && scene.errors ? `${title} × ${scene.errors.enlarged}` : nothing && { contours: `${title} (georef export-raster --contours)`, changes: `${title} (georef change)` }[name] || title;
    byId("overlays").append(element("label", { class: "check" }, element("input", { type: "checkbox", value: name, disabled: nothing, onchange: (event) => {
      const kept = new Set(state.shown);
      kept[event.target.checked ? "add" : "delete"](name);
      if (name === "points by σ" && event.target.checked) kept.add("tie points");
      change({ shown: kept });
    } }), ` ${text}`));
  }
  byId("colouring").querySelector("[value=sigma]").disabled = !scene.has_sigma;
  byId("photographs").append(element("option", { value: "" }, "—"), ...scene.cameras.map(({ name }, k) => element("option", { value: k }, name)));
  SIDES.forEach((side, k) => byId("clip-sides").append(element("label", {}, `${side} `, element("input", { type: "range", min: -1.5 * scene.radius_m, max: 1.5 * scene.radius_m, step: scene.radius_m / 200, "data-side": k, "aria-label": side, oninput: setBox }))));
  byId("keys").append(...KEYS.map(([key, text]) => element("tr", {}, element("th", {}, ...key.split(" ").flatMap((one) => [element("kbd", {}, one), " "])), element("td", {}, text))));
}

function setBox() {
  const box = [...byId("clip-sides").querySelectorAll("input")].map((input) => Number(input.value));
  for (const k of [0, 1, 2]) if (box[k] > box[k + 3]) box[k + 3] = box[k];
  change({ box });
}

async function watch() {
  const { changed } = await get("changed").catch(() => ({ changed: false }));
  if (changed) notice("The model has changed since it was read: measurements are those of the old one.", { action: { label: "Read the model again", act: () => safely(async () => { await post("read-again", {}); location.reload(); }) } });
  setTimeout(watch, 4000);
}

async function begin() {
  readState();
  await loadScene();
  build();
  for (const name of ["see", "measure", "mark"]) byId(`tab-${name}`).onclick = () => change({ tab: name }, { step: true });
  document.querySelector("[role=tablist]").addEventListener("keydown", (event) => {
    const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key], names = ["see", "measure", "mark"];
    if (step) { change({ tab: names[(names.indexOf(state.tab) + step + 3) % 3] }, { step: true }); byId(`tab-${state.tab}`).focus(); event.stopPropagation(); }
  });
  byId("home").onclick = KEYS[0][2];
  byId("top").onclick = KEYS[1][2];
  byId("north").onclick = northUp;
  byId("fold").onclick = fold;
  byId("help-button").onclick = () => byId("help").showModal();
  byId("leave").onclick = leave;
  byId("colouring").onchange = (event) => change({ colouring: event.target.value });
  byId("share").oninput = (event) => change({ share: Number(event.target.value) });
  byId("light").onchange = (event) => change({ light: event.target.value });
  byId("photographs").onchange = (event) => change({ photo: event.target.value === "" ? null : Number(event.target.value) }, { step: true });
  byId("strip-on").onchange = (event) => { change({ strip: event.target.checked }); if (place) showSeen(place); };
  byId("clip-on").onchange = (event) => change({ box: event.target.checked ? whole() : null });
  byId("clip-here").onclick = () => {
    const middle = placeUnder(camera().width / 2, camera().height / 2) ?? state.view.target, half = 0.4 * halfSeen();
    change({ box: [...middle.map((v) => v - half), ...middle.map((v) => v + half)] });
  };
  addEventListener("keydown", pressed);
  onState(showState);
  listen();
  if (innerWidth <= 720) fold();
  await measure.begin();
  await mark.begin();
  showState();
  look();
  document.body.dataset.ready = "yes";
  watch();
}
safely(begin);
