// What all parts of the page share: requests, elements, notices, state in the address, steps that can be undone.

export const byId = (id) => document.getElementById(id);

export function element(name, attributes = {}, ...children) {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (key.startsWith("on")) made.addEventListener(key.slice(2), value);
    else if (key === "class") made.className = value || "";
    else if (value !== false && value !== undefined) made.setAttribute(key, value === true ? "" : value);
  }
  made.append(...children);
  return made;
}

export async function ask(path, { method = "GET", body, signal } = {}) {
  let response;
  try {
    response = await fetch(path, { method, signal, body: body === undefined ? undefined : JSON.stringify(body) });
  } catch (error) {
    if (error.name === "AbortError") throw error;
    throw new Error("The viewer does not answer: was it ended in the terminal?");
  }
  if (!response.ok) throw new Error((await response.json().catch(() => ({}))).error ?? `The viewer failed (${response.status}).`);
  return response;
}
export const get = async (path) => (await ask(path)).json();
export const post = async (path, body, method = "POST") => (await ask(path, { method, body })).json();

export function notice(text, { failed = false, action } = {}) {
  const lines = byId("notices");
  if ([...lines.children].some((line) => line.dataset.text === text)) return;
  const line = element("div", { class: failed ? "notice failed" : "notice", "data-text": text, role: failed ? "alert" : false },
    element("span", {}, text));
  if (action) line.append(element("button", { onclick: () => { line.remove(); action.act(); } }, action.label));
  line.append(element("button", { "aria-label": "Close", onclick: () => line.remove() }, "×"));
  lines.append(line);
  if (!failed && !action) setTimeout(() => line.remove(), 6000);
}

// Runs a step of the user; what fails is told.
export async function safely(step) {
  try {
    return await step();
  } catch (error) {
    if (error.name !== "AbortError") notice(error.message, { failed: true });
    return undefined;
  }
}

export function question(text) {
  const dialog = byId("ask");
  byId("question").textContent = text;
  dialog.returnValue = "no";
  dialog.showModal();
  return new Promise((answer) => dialog.addEventListener("close", () => answer(dialog.returnValue === "yes"), { once: true }));
}

// The state of this page is in its address: a reload, another tab and the back button keep it.
export const state = { tab: "see", photo: null, view: null, shown: new Set(["points", "saved"]), colouring: "photographs", share: 1, box: null, light: "", kind: "point", point: "", strip: false };
const listeners = new Set();
export const onState = (listener) => listeners.add(listener);

export function readState() {
  const given = new URLSearchParams(location.hash.slice(1));
  const numbers = (name, count) => {
    const found = (given.get(name) ?? "").split(",").map(Number);
    return given.get(name) && found.length === count && found.every(Number.isFinite) ? found : null;
  };
  const view = numbers("view", 7), box = numbers("box", 6), photo = given.get("photo");
  Object.assign(state, {
    tab: ["see", "measure", "mark"].includes(given.get("tab")) ? given.get("tab") : "see",
    photo: photo && /^\d+$/.test(photo) ? Number(photo) : null,
    view: view ? { target: view.slice(0, 3), distance: view[3], heading: view[4], pitch: view[5], fov: view[6] } : state.view,
    shown: new Set(given.has("shown") ? given.get("shown").split(",").filter(Boolean) : ["points", "saved"]),
    colouring: given.get("colours") ?? "photographs", share: Number(given.get("share") ?? 1), box,
    light: given.get("light") ?? "", kind: given.get("kind") ?? "point", point: given.get("point") ?? "",
    strip: given.has("strip"),
  });
}

function fragment() {
  const { view } = state, given = new URLSearchParams();
  given.set("tab", state.tab);
  if (view) given.set("view", [...view.target, view.distance, view.heading, view.pitch, view.fov].map((v) => +v.toFixed(4)).join(","));
  if (state.photo !== null) given.set("photo", state.photo);
  given.set("shown", [...state.shown].join(","));
  if (state.colouring !== "photographs") given.set("colours", state.colouring);
  if (state.share !== 1) given.set("share", state.share);
  if (state.box) given.set("box", state.box.map((v) => +v.toFixed(3)).join(","));
  if (state.light) given.set("light", state.light);
  given.set("kind", state.kind);
  if (state.point) given.set("point", state.point);
  if (state.strip) given.set("strip", "");
  return `#${given.toString().replaceAll("%2C", ",")}`;
}

// Takes a change over; one that the back button brings back has a place in the history.
export function change(values, { step = false } = {}) {
  Object.assign(state, values);
  const address = fragment();
  if (address !== location.hash) history[step ? "pushState" : "replaceState"](null, "", address);
  for (const listener of listeners) listener();
}
addEventListener("popstate", () => { readState(); for (const listener of listeners) listener(); });

// Steps that Ctrl-Z undoes, the last one first, apart for each tab; Ctrl-Shift-Z does them again.
const steps = { see: [], measure: [], mark: [] }, undone = { see: [], measure: [], mark: [] };
let again = false;  // a step that is done again keeps those behind it
export const did = (tab, name, undo, redo) => {
  steps[tab].push({ name, undo, redo });
  if (steps[tab].length > 100) steps[tab].shift();
  if (!again) undone[tab] = [];
};
export async function redo(tab = state.tab) {
  const next = undone[tab].pop();
  if (!next) return notice("Nothing to do again.");
  again = true;
  try { await next.redo(); } finally { again = false; }
  return notice(`Done again: ${next.name}.`);
}
export async function undo(tab = state.tab) {
  const last = steps[tab].at(-1);
  if (!last) return notice("Nothing to undo.");
  await last.undo();
  steps[tab].splice(steps[tab].indexOf(last), 1);
  if (last.redo) undone[tab].push(last); else undone[tab] = [];
  return notice(`Undone: ${last.name}.`);
}

// Crop of a photograph around a pixel, drawn on a small canvas; `draw` adds to it, in pixels of the photograph.
export function crop(camera, px, half, draw) {
  const side = 264, canvas = element("canvas", { width: side, height: side });
  const image = new Image();
  image.addEventListener("load", () => {
    const context = canvas.getContext("2d"), scale = side / (2 * half);
    context.drawImage(image, 0, 0, side, side);
    context.setTransform(scale, 0, 0, scale, (half - px[0]) * scale, (half - px[1]) * scale);
    context.lineWidth = 2 / scale;
    draw?.(context, 1 / scale);
  });
  image.src = `photo/${camera}?x=${px[0]}&y=${px[1]}&half=${half}&px=${side}`;
  return canvas;
}

export function cross(context, [x, y], arm, colour, diagonal = false) {
  context.strokeStyle = colour;
  context.beginPath();
  const ends = diagonal ? [[arm, arm], [arm, -arm]] : [[arm, 0], [0, arm]];
  for (const [dx, dy] of ends) { context.moveTo(x - dx, y - dy); context.lineTo(x + dx, y + dy); }
  context.stroke();
}
