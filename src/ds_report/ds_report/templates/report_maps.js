{# SPDX-License-Identifier: Apache-2.0 #}
// ---- the feature maps ---------------------------------------------------------------------------------------------
const CONFIG = { displayModeBar: false, responsive: true };
/** On a phone a label would cover the cell under the finger: its text is shown below the map instead. */
const narrow = matchMedia("(max-width: 640px), (hover: none)");
const VALUES = {
  probability: { title: "failure probability", top: () => 1, of: (cell) => cell.probability, text: (cell) => cell.probability.toFixed(2) },
  quality_loss: { title: "quality loss", top: () => 1, of: (cell) => cell.quality_loss, text: (cell) => cell.quality_loss.toFixed(2) },
  tests: {
    title: "tests", top: () => mostTests, of: (cell) => cell.tests,
    text: (cell) => (cell.failures === null ? String(cell.tests) : `${cell.failures}/${cell.tests}`),
  },
};
const dimensions = data.axes.length;
const bins = data.axes.map((axis) => axis.begins.slice(1).map((_, k) => axis.low + k));
const [across, upwards] = bins;
const cells = {}; // map name -> key of a cell -> its values
for (const [name, map] of Object.entries(data.maps)) {
  cells[name] = {};
  for (const row of map.cells) {
    const [tests, failures, probability, interval, quality_loss] = row.slice(dimensions);
    cells[name][row.slice(0, dimensions).join("-")] = { tests, failures, probability, interval, quality_loss };
  }
}
const mostTests = Math.max(1, ...Object.values(cells).flatMap((map) => Object.values(map).map((cell) => cell.tests)));
const placeIndex = Object.fromEntries(data.places.map(([place], index) => [place.join("-"), index]));

const state = { value: "probability", slice: null, chosen: null };
const drawn = []; // {plot, name} of every map on the page

const keyAt = (row, column) => [across[column], upwards[row], ...(dimensions > 2 ? [state.slice] : [])].join("-");
/** `curvature 0.17 to 0.18 1/m (radius 5.9 m to 5.6 m)`, or `turns count 3` where a bin is one whole number. */
function binWords(axis, bin) {
  const at = bin - axis.low;
  const [from, to] = [axis.begins[at], axis.begins[at + 1]];
  const [title, unit] = axis.title.split(", ");
  const radius = axis.radii ? ` (radius ${axis.radii[at]} to ${axis.radii[at + 1]})` : "";
  return `${title} ${axis.whole ? from : `${from} to ${to}`}${unit ? ` ${unit}` : ""}${radius}`;
}
/** `0.17 (5.9 m)`: lower edge of a bin, with the radius of such a bend. */
const beginWords = (axis, bin) => axis.begins[bin - axis.low] + (axis.radii ? ` (${axis.radii[bin - axis.low]})` : "");
const axisTitle = (axis) => axis.title + (axis.radii ? " (bend radius)" : "");
const placeWords = (key) => key.split("-").map((bin, i) => binWords(data.axes[i], Number(bin))).join(", ");
/** `0.13 to 0.69`; a short interval next to 0 has one more digit. */
function range(interval) {
  if (!interval) return "not known";
  const digits = interval[1] < 0.01 ? 3 : 2;
  return `${interval[0].toFixed(digits)} to ${interval[1].toFixed(digits)}`;
}

function hoverText(name, key) {
  const cell = cells[name][key];
  const where = key.split("-").map((bin, i) => binWords(data.axes[i], Number(bin))).join("<br>");
  if (!cell) return `${where}<br><i>no test: nothing is known</i>`;
  const failed = cell.failures === null ? `${plural(cell.tests, "test")} on each sibling` : `${cell.failures} of ${plural(cell.tests, "test")} failed`;
  return `${where}<br><b>${failed}</b><br>failure probability ${cell.probability.toFixed(2)}<br>95%: ${range(cell.interval)}<br>quality loss ${cell.quality_loss.toFixed(2)}`;
}

function trace(name, width) {
  const value = VALUES[state.value];
  const rows = upwards.map((_, row) => across.map((__, column) => keyAt(row, column)));
  const each = (make) => rows.map((row) => row.map(make));
  // Show numbers in the cells only if they are large enough to read.
  const [wide, high] = [(width - (data.axes[1].radii ? 92 : 58)) / across.length, (data.layouts.map.height - 52) / upwards.length];
  const size = Math.min(13, Math.floor(wide / 2.6), Math.floor(high / 1.25));
  return {
    type: "heatmap", x: across, y: upwards, xgap: 1, ygap: 1, showscale: false, hoverongaps: true, hoverinfo: narrow.matches ? "none" : "text",
    z: each((key) => (cells[name][key] ? value.of(cells[name][key]) : null)),
    text: each((key) => (cells[name][key] ? value.text(cells[name][key]) : "")),
    hovertext: each((key) => hoverText(name, key)),
    texttemplate: size >= 8 ? "%{text}" : "", textfont: { size: Math.max(size, 8) },
    colorscale: data.layouts.scales[state.value], zmin: 0, zmax: value.top(),
  };
}

/** Limit the number of ticks, so that labels do not overlap. */
function ticks(k, most) {
  const step = Math.ceil(bins[k].length / most);
  const shown = bins[k].filter((_, i) => i % step === 0);
  return { tickmode: "array", tickvals: shown, ticktext: shown.map((bin) => beginWords(data.axes[k], bin)) };
}

/** The outline of the chosen cell: dark on pale, visible on every colour. */
function outline() {
  if (!state.chosen) return [];
  const [x, y, z] = state.chosen.split("-").map(Number);
  if (dimensions > 2 && z !== state.slice) return [];
  const box = { type: "rect", x0: x - 0.5, x1: x + 0.5, y0: y - 0.5, y1: y + 0.5 };
  return [{ ...box, line: { color: "#ffffff", width: 5 } }, { ...box, line: { color: "#0b3d91", width: 3 } }];
}

function layout(width) {
  const base = data.layouts.map;
  const axis = (k, layoutAxis, most) => ({
    ...layoutAxis, ...ticks(k, most), range: [bins[k][0] - 0.5, bins[k].at(-1) + 0.5],
    title: { ...layoutAxis.title, text: axisTitle(data.axes[k]) },
  });
  return { ...base, shapes: outline(), xaxis: axis(0, base.xaxis, Math.max(4, width / (data.axes[0].radii ? 90 : 34))), yaxis: axis(1, base.yaxis, base.height / 16) };
}

function mapFigure(name) {
  const plot = html("div", {
    class: "plot", tabindex: "0", role: "group", "data-map": name,
    "aria-label": `Map ${data.maps[name].title}. Arrow keys choose a cell; its tests are shown below.`,
  });
  const readout = html("p", { class: "readout" });
  drawn.push({ plot, name, readout });
  return html("figure", { class: "map" },
    html("figcaption", {}, html("b", {}, data.maps[name].title), html("span", {}, data.maps[name].about)), plot, readout);
}

/** Let a chart shrink with a printed page, by giving its drawing a viewBox. */
function scalable(plot) {
  for (const part of plot.querySelectorAll(".main-svg")) part.setAttribute("viewBox", `0 0 ${part.getAttribute("width")} ${part.getAttribute("height")}`);
}
async function newPlot(plot, traces, layout) {
  await Plotly.newPlot(plot, traces, layout, CONFIG);
  scalable(plot);
  plot.on("plotly_afterplot", () => scalable(plot));
}

/** Draw or update a map; the same call does both. */
async function draw({ plot, name }) {
  const width = plot.clientWidth;
  if (!width) return; // inside a closed fold
  const first = !plot.data;
  await Plotly.react(plot, [trace(name, width)], layout(width), CONFIG);
  scalable(plot);
  if (first) link(plot);
}
const drawAll = () => Promise.all(drawn.map(draw));

/** Hovering over a cell in one map shows it in all: the same roads on other simulators. */
function link(plot) {
  const others = () => drawn.filter((other) => other.plot !== plot && other.plot.data && other.plot.clientWidth);
  plot.on("plotly_hover", ({ points: [point] }) => {
    if (narrow.matches) return;
    for (const other of others()) Plotly.Fx.hover(other.plot, [{ curveNumber: 0, xval: point.x, yval: point.y }]);
  });
  plot.on("plotly_unhover", () => {
    for (const other of others()) Plotly.Fx.unhover(other.plot);
  });
  plot.on("plotly_afterplot", () => scalable(plot));
  plot.on("plotly_click", async ({ points: [point] }) => {
    const key = keyAt(...point.pointIndex);
    if (narrow.matches) readOut(key);
    await choose(key);
    // Scroll to the tests if they would open out of sight; otherwise keep the maps under the mouse.
    if (!narrow.matches && panel.getBoundingClientRect().top > 0.75 * innerHeight) panel.scrollIntoView();
  });
}

/** Show a cell's values below every map. */
function readOut(key) {
  for (const { name, readout } of drawn) {
    const cell = cells[name][key];
    const failed = !cell ? "no test: nothing is known"
      : `failure probability ${cell.probability.toFixed(2)}, 95%: ${range(cell.interval)}${cell.failures === null ? "" : `; ${cell.failures} of ${plural(cell.tests, "test")} failed`}`;
    readout.replaceChildren(`${placeWords(key)}: ${failed}. `, html("a", { href: "#cell" }, "Its tests"));
  }
}

const STEPS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
function onKey(event) {
  const step = STEPS[event.key];
  if (!step || !event.target.closest(".plot[data-map]")) return;
  event.preventDefault();
  const [x, y] = (state.chosen ?? keyAt(0, 0)).split("-").map(Number);
  const [column, row] = [across.indexOf(x + step[0]), upwards.indexOf(y + step[1])];
  if (column >= 0 && row >= 0) choose(keyAt(row, column));
}

// ---- what the maps show: value, and slice of a third feature ------------------------------------------------------
function legend() {
  const stops = data.layouts.scales[state.value].map(([at, colour]) => `${colour} ${100 * at}%`).join(", ");
  const [bar, low, high] = ["bar", "low", "high"].map((part) => document.getElementById(`legend-${part}`));
  bar.style.background = `linear-gradient(to right, ${stops})`;
  low.textContent = state.value === "tests" ? "0" : { probability: "0 never fails", quality_loss: "0 best drive" }[state.value];
  high.textContent = state.value === "tests" ? plural(mostTests, "test") : { probability: "1 always fails", quality_loss: "1 worst drive" }[state.value];
}

function showValue(value) {
  state.value = value;
  for (const button of document.querySelectorAll("[data-value]")) button.setAttribute("aria-pressed", String(button.dataset.value === value));
  for (const hint of document.querySelectorAll("[data-hint]")) hint.hidden = hint.dataset.hint !== value;
  legend();
  return drawAll();
}

function showSlice(bin) {
  state.slice = bin;
  document.getElementById("slice").value = String(bin);
  return drawAll();
}

/** Let the user choose the bin of a third feature; a map shows one at a time. */
function sliceChooser() {
  if (dimensions < 3) return;
  const box = document.getElementById("slices");
  const counts = {};
  for (const [place, tests] of data.places) counts[place[2]] = (counts[place[2]] ?? 0) + tests.length;
  const filled = bins[2].filter((bin) => counts[bin]);
  const select = html("select", { id: "slice" },
    ...filled.map((bin) => html("option", { value: String(bin) }, `${binWords(data.axes[2], bin)} (${plural(counts[bin], "test")})`)));
  select.addEventListener("change", () => showSlice(Number(select.value)));
  const step = (by, text, label) => {
    const button = html("button", { type: "button", "aria-label": label }, text);
    button.addEventListener("click", () => {
      const next = filled[filled.indexOf(state.slice) + by];
      if (next !== undefined) showSlice(next);
    });
    return button;
  };
  const title = data.axes[2].title.split(", ")[0];
  box.append(html("label", { for: "slice" }, `The third feature, ${title}: `), step(-1, "◀", `smaller ${title}`), select, step(1, "▶", `larger ${title}`));
  box.hidden = false;
  state.slice = data.selected ? data.selected[2] : filled[0] ?? bins[2][0];
  select.value = String(state.slice);
}

/** All numbers of the maps side by side, to read or copy. */
function numbersTable(box) {
  const names = data.groups.compared;
  const keys = [...new Set(names.flatMap((name) => Object.keys(cells[name])))];
  const order = (key) => key.split("-").map((bin) => bin.padStart(9, "0")).join();
  keys.sort((a, b) => (order(a) < order(b) ? -1 : 1));
  const head = html("tr", {}, ...data.axes.map((axis) => html("th", {}, axisTitle(axis))), ...names.map((name) => html("th", { class: "number" }, data.maps[name].title)));
  const rows = keys.map((key) => {
    const numbers = names.map((name) => {
      const cell = cells[name][key];
      const failed = cell && cell.failures !== null ? `, ${cell.failures} of ${cell.tests}` : "";
      return html("td", { class: "number" }, cell ? `${cell.probability.toFixed(2)} [${range(cell.interval)}]${failed}` : "no test");
    });
    const places = key.split("-").map((bin, i) => html("td", {}, beginWords(data.axes[i], Number(bin))));
    return html("tr", {}, ...places, ...numbers);
  });
  box.append(html("table", {}, html("thead", {}, head), html("tbody", {}, ...rows)));
}
