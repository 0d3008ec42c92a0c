const page = JSON.parse(document.getElementById("scene").textContent);
const byId = (id) => document.getElementById(id);
const COLOURS = { control: "#ffcc33", check: "#4cc9f0", measurement: "#ff6b9d", photograph: "#9fe870" };

function fail(text) {
  byId("message").hidden = false;
  byId("message").textContent = text;
}

// Names come from files of other people: text only ever enters the page as text, never as HTML.
function element(parent, tag, text) {
  const made = parent.appendChild(document.createElement(tag));
  if (text !== undefined) made.textContent = text;
  return made;
}

function addFacts(parent, facts) {
  for (const { name, value } of facts) {
    element(parent, "dt", name);
    element(parent, "dd", value);
  }
}

function describe() {
  document.title = page.title;
  byId("title").textContent = page.title;
  addFacts(byId("facts"), page.facts);
  if (page.cautions.length > 0) {
    byId("cautions").hidden = false;
    byId("cautions").querySelector("summary").textContent = `Cautions (${page.cautions.length})`;
    for (const caution of page.cautions) element(byId("cautions").querySelector("ul"), "li", caution);
  }
}

// A line with a box and a swatch; `change` is called with whether the box is ticked.
function addSwitch(parent, title, colour, ticked, change) {
  const label = element(parent, "label");
  const box = element(label, "input");
  box.type = "checkbox";
  box.checked = ticked;
  box.addEventListener("change", () => change(box.checked));
  const swatch = element(label, "span");
  swatch.className = "swatch";
  swatch.style.background = colour;
  element(label, "span", title);
  element(parent, "br");
}

// Coordinates in a CRS are polynomials in East-North-Up at the middle of the scene, fitted when the page was written.
// Empty: the place lies outside the box in which they hold.
function coordinates(fit, place) {
  const unit = place.map((value, axis) => value / fit.half_extent_m[axis]);
  if (unit.some((value) => Math.abs(value) > 1)) return "";
  const xyz = [0, 1, 2].map((axis) => fit.exponents.reduce(
    (sum, [i, j, k], row) => sum + fit.coefficients[row][axis] * unit[0] ** i * unit[1] ** j * unit[2] ** k, 0));
  return fit.axes.map(({ name, unit, decimals }, axis) => `${name} ${xyz[axis].toFixed(decimals)} ${unit}`).join("  ");
}

// The scale bar: the longest of 1, 2, 5, 10 … metres that is at most 150 pixels wide.
function drawScale(metrePerPixel) {
  const longest = 150 * metrePerPixel;
  const power = 10 ** Math.floor(Math.log10(longest));
  const length = power * [5, 2, 1].find((digit) => digit * power <= longest);
  byId("bar").style.width = `${length / metrePerPixel}px`;
  byId("length").textContent = length >= 1000 ? `${length / 1000} km` : length >= 1 ? `${length} m` : `${Math.round(length * 100)} cm`;
}
