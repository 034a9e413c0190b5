{# SPDX-License-Identifier: Apache-2.0 #}
// ---- the chosen cell and its tests --------------------------------------------------------------------------------
const FIRST_TESTS = 24;
const panel = document.getElementById("cell");

/** Choose a cell: outline it in every map, and open its tests below. */
async function choose(key, { remember = true, testId = null } = {}) {
  state.chosen = key;
  if (dimensions > 2 && Number(key.split("-")[2]) !== state.slice) await showSlice(Number(key.split("-")[2]));
  const shapes = outline();
  for (const { plot } of drawn) if (plot.data && plot.clientWidth) Plotly.relayout(plot, { shapes });
  if (remember) history.replaceState(null, "", `#cell=${key}`);
  const tests = key in placeIndex ? await testsOf(placeIndex[key]) : [];
  if (state.chosen === key) showCell(key, tests, testId); // or another cell was chosen meanwhile
}

function showCell(key, tests, testId) {
  const heading = html("h3", {}, `The chosen cell: ${placeWords(key)}`);
  panel.replaceChildren(heading);
  document.getElementById("said").textContent = `${placeWords(key)}: ${plural(tests.length, "test")}`;
  if (!tests.length) {
    panel.append(html("p", {}, "No test has such a road, so nothing is known here."));
    return;
  }
  panel.append(html("div", { class: "scroll" }, cellTable(key)));
  const list = html("div", { class: "tests", role: "group", "aria-label": "Tests of this cell, the worst one first" });
  const detail = html("article", { class: "test" });
  const shown = tests.findIndex((test) => test.id === testId);
  showTests(list, detail, tests, 0, Math.max(FIRST_TESTS, shown + 1));
  panel.append(
    html("h4", {}, tests.length > 1 ? `${tests.length} tests, the worst one first` : "1 test"),
    ...(data.conditions && tests.length > 1 ? [conditionFilter(list, detail, tests)] : []), html("div", { class: "opened" }, list, detail));
  list.querySelectorAll("button")[Math.max(shown, 0)].click();
}

/** A field that keeps the tests whose conditions meet all of its terms. */
function conditionFilter(list, detail, tests) {
  const field = html("input", { type: "search", placeholder: "visibility < 60, line_contrast", "aria-label": "Filter by conditions" });
  field.addEventListener("input", () => {
    list.replaceChildren();
    const met = tests.filter((test) => meets(test.conditions, field.value));
    showTests(list, detail, met, 0, FIRST_TESTS);
    document.getElementById("said").textContent = plural(met.length, "test");
  });
  return html("p", {}, html("label", {}, "Only tests with the conditions ", field));
}

/** Whether conditions meet all terms: a name, or a name compared with a number. */
function meets(conditions, terms) {
  const values = Object.fromEntries(conditions.split(",").filter(Boolean).map((pair) => pair.split("=")));
  return terms.split(",").map((term) => term.trim()).filter(Boolean).every((term) => {
    const [, name, sign, number] = term.match(/^([a-z_]+)\s*(?:([<>=])\s*(-?[\d.]+))?$/) || [null, term];
    if (!(name in values)) return !sign && Object.keys(values).some((known) => known.startsWith(name));
    const [value, bound] = [Number(values[name]), Number(number)];
    return !sign || (sign === "<" ? value < bound : sign === ">" ? value > bound : value === bound);
  });
}

function showTests(list, detail, tests, from, to) {
  for (const test of tests.slice(from, to)) list.append(testButton(test, detail, list));
  const rest = tests.length - to;
  if (rest <= 0) return;
  const more = html("button", { type: "button", class: "more" }, `${Math.min(rest, FIRST_TESTS)} more of ${rest}`);
  more.addEventListener("click", () => {
    more.remove();
    showTests(list, detail, tests, to, to + FIRST_TESTS);
  });
  list.append(more);
}

function cellTable(key) {
  const names = [...data.groups.compared, ...data.groups.merges];
  const head = ["map", "failed", "failure probability", "95% interval", "quality loss"];
  const rows = names.map((name) => {
    const cell = cells[name][key];
    const failed = !cell ? "no test" : cell.failures === null ? "–" : `${cell.failures} of ${cell.tests}`;
    const numbers = cell ? [cell.probability.toFixed(2), range(cell.interval), cell.quality_loss.toFixed(2)] : ["–", "–", "–"];
    return html("tr", {}, html("td", {}, data.maps[name].title), ...[failed, ...numbers].map((text) => html("td", { class: "number" }, text)));
  });
  const heads = head.map((text, index) => html("th", index ? { class: "number" } : {}, text));
  return html("table", {}, html("thead", {}, html("tr", {}, ...heads)), html("tbody", {}, ...rows));
}

/** A thumbnail of a road, with its outcome on every simulator. */
function testButton(test, detail, list) {
  const { lx, ly, rx, ry, cx, cy } = test.road;
  const [xs, ys] = [[...lx, ...rx], [...ly, ...ry]];
  const [left, right, low, high] = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
  const size = Math.max(right - left, high - low) + 12;
  const [x0, y0] = [(left + right - size) / 2, (low + high - size) / 2];
  const line = (x, y) => x.map((v, i) => `${(v - x0).toFixed(1)},${(size - (y[i] - y0)).toFixed(1)}`).join(" ");
  const stamp = svg("svg", { viewBox: `0 0 ${size} ${size}`, "aria-hidden": "true" },
    svg("polyline", { points: line(cx, cy), fill: "none", stroke: "#8b929b", "stroke-width": data.road || 2 * data.lane, "stroke-linejoin": "round" }),
    svg("circle", { cx: cx[0] - x0, cy: size - (cy[0] - y0), r: size / 22, style: "fill: var(--ink)" }));
  const outcomes = test.runs.map((run, index) => {
    const chip = html("span", { class: run && run.failed ? "chip bad" : "chip" }, `${run ? (run.failed ? "✗" : "✓") : "–"} ${data.simulators[index].name}`);
    chip.title = `${data.simulators[index].name}: ${run ? run.outcome : test.excluded[index] || "no outcome"}`;
    return chip;
  });
  const button = html("button", { type: "button", "data-test": test.id, "aria-pressed": "false" }, stamp, html("span", {}, html("b", {}, test.id), ...outcomes));
  button.addEventListener("click", () => {
    for (const other of list.querySelectorAll("button")) other.setAttribute("aria-pressed", String(other === button));
    showTest(test, detail);
  });
  return button;
}

const radiusWords = (curvature) => (curvature > 0 ? `${(1 / curvature).toFixed(1)} m in radius` : "none, straight");

/** Conditions for reading; the commands beside them have all digits. */
const conditionWords = (test) => test.conditions.split(",").map((pair) => pair.split("="))
  .map(([name, value]) => `${name} = ${Number(Number(value).toPrecision(3))}`).join(", ");

// ---- one test -----------------------------------------------------------------------------------------------------
function showTest(test, detail) {
  const origin = `Road ${test.road.id}: ${test.road.length} m, ${plural(test.road.turns, "turn")}, tightest bend ${radiusWords(test.road.curvature)} (curvature ${test.road.curvature} 1/m). Found by the search on ${test.sibling}, run ${test.run}, test ${test.number}; seed ${test.seed}.${test.conditions ? ` Conditions ${conditionWords(test)}.` : ""}`;
  const [road, lateral, steering] = ["road", "lateral", "steering"].map((kind) => html("div", { class: "plot", "data-chart": kind }));
  const chart = (title, plot) => html("figure", {}, html("figcaption", {}, title), plot);
  detail.replaceChildren(
    html("h4", {}, `Test ${test.id}`), html("p", { class: "hint" }, origin), keys(),
    html("div", { class: "charts" },
      chart("The road from above, and every simulator's drive", road),
      html("div", {}, chart("Lateral position in the lane, in driving direction: left is up", lateral), chart("Steering: left is up", steering))),
    replayOf(test), html("div", { class: "scroll" }, outcomeTable(test)), commandsOf(test), drivePictures(test));
  drawRoad(road, test);
  drawLines(lateral, test, "lateral", road);
  drawLines(steering, test, "steering", road);
}

function keys() {
  const dashes = { solid: "", dash: "9 6", dot: "2 4", dashdot: "9 4 2 4", longdash: "14 6" };
  const list = html("ul", { class: "keys" });
  for (const { name, role, colour, dash } of data.simulators) {
    const line = svg("line", { x1: 0, y1: 5, x2: 34, y2: 5, stroke: colour, "stroke-width": 3, "stroke-dasharray": dashes[dash] });
    list.append(html("li", {}, svg("svg", { viewBox: "0 0 34 10", "aria-hidden": "true" }, line), `${name} (${role})`));
  }
  list.append(html("li", {}, html("b", {}, "✗ "), "where the run failed"));
  return list;
}

const side = (lateral) => `${Math.abs(lateral).toFixed(2)} m ${lateral >= 0 ? "right" : "left"} of the lane's centre`;
const lineOf = (index) => ({ color: data.simulators[index].colour, dash: data.simulators[index].dash, width: 2.5 });

function drawRoad(plot, test) {
  const { cx, cy, lx, ly, rx, ry } = test.road;
  const still = { type: "scatter", mode: "lines", hoverinfo: "skip" };
  const traces = [
    { ...still, x: [...lx, ...rx.slice().reverse()], y: [...ly, ...ry.slice().reverse()], fill: "toself", fillcolor: "#d9dce1", line: { width: 0 } },
    { ...still, x: lx, y: ly, line: { color: "#70757d", width: 1.5 } },
    { ...still, x: rx, y: ry, line: { color: "#70757d", width: 1.5 } },
    { ...still, x: cx, y: cy, line: { color: "#b58900", width: 1.5 } },
    { ...still, mode: "markers+text", x: [(cx[0] + rx[0]) / 2], y: [(cy[0] + ry[0]) / 2], text: ["start"], textposition: "bottom center", cliponaxis: false, marker: { size: 9, color: "#1e2329" } },
  ];
  test.runs.forEach((run, index) => {
    if (!run) return;
    const text = run.x.map((_, i) => `<b>${data.simulators[index].name}</b><br>${run.time[i].toFixed(1)} s, ${run.distance[i].toFixed(0)} m driven<br>${side(run.lateral[i])}`);
    traces.push({ type: "scatter", mode: "lines", x: run.x, y: run.y, line: lineOf(index), hovertext: text, hoverinfo: "text", name: data.simulators[index].name });
  });
  test.runs.forEach((run, index) => {
    const at = failure(run);
    if (at < 0) return;
    const cross = { type: "scatter", mode: "markers", x: [run.x[at]], y: [run.y[at]], hovertext: [`<b>${data.simulators[index].name}</b>: ${run.outcome}<br>${run.time[at].toFixed(1)} s, ${side(run.lateral[at])}`], hoverinfo: "text" };
    traces.push({ ...cross, hoverinfo: "skip", marker: { symbol: "x", size: 15, color: "#ffffff" } });
    traces.push({ ...cross, name: "failed", marker: { symbol: "x", size: 11, color: data.simulators[index].colour } });
  });
  // Hovering over the other charts moves this marker to the same place on the road.
  traces.push({ ...still, mode: "markers", x: [], y: [], marker: { size: 12, color: "rgba(0,0,0,0)", line: { color: "#1e2329", width: 2.5 } } });
  return newPlot(plot, traces, data.layouts.road);
}

/** A value over the distance driven; the lane is grey behind the lateral position. */
async function drawLines(plot, test, value, road) {
  const traces = [];
  const runs = [];
  test.runs.forEach((run, index) => {
    if (!run || !run[value].length) return;
    runs.push(run);
    traces.push({ type: "scatter", mode: "lines", x: run.distance, y: run[value], line: { ...lineOf(index), width: 2 }, name: data.simulators[index].name, hovertemplate: "%{y:.2f}" });
    const at = failure(run);
    if (at < 0) return;
    runs.push(run);
    traces.push({ type: "scatter", mode: "markers", x: [run.distance[at]], y: [run[value][at]], hoverinfo: "skip", marker: { symbol: "x", size: 10, color: data.simulators[index].colour } });
  });
  if (!traces.length) {
    plot.append(html("p", { class: "hint" }, value === "steering" ? "The steering was not recorded." : "Nothing was driven."));
    return;
  }
  const half = data.lane / 2;
  const layout = { ...data.layouts[value] };
  if (value === "lateral") {
    const border = (y) => ({ type: "line", xref: "paper", x0: 0, x1: 1, y0: y, y1: y, line: { color: "#70757d", width: 1.5 } });
    layout.shapes = [{ type: "rect", xref: "paper", x0: 0, x1: 1, y0: -half, y1: half, fillcolor: "#d9dce1", opacity: 0.6, layer: "below", line: { width: 0 } }, border(-half), border(half)];
    const reach = Math.max(1.15 * half, ...runs.flatMap((run) => run.lateral.map((v) => 1.08 * Math.abs(v))));
    layout.yaxis = { ...layout.yaxis, autorange: false, range: [reach, -reach] };
  }
  await newPlot(plot, traces, layout);
  const marker = road.data ? road.data.length - 1 : -1;
  const mark = (at) => road.data && Plotly.restyle(road, { x: [at.map((p) => p[0])], y: [at.map((p) => p[1])] }, [marker < 0 ? road.data.length - 1 : marker]);
  plot.on("plotly_hover", ({ points }) => mark(points.map((p) => [runs[p.curveNumber].x[p.pointNumber], runs[p.curveNumber].y[p.pointNumber]])));
  plot.on("plotly_unhover", () => mark([]));
}

function outcomeTable(test) {
  const head = ["simulator", "outcome", "fitness, m", "largest lateral position, m", "simulated time, s"];
  const rows = data.simulators.map((simulator, index) => {
    const run = test.runs[index];
    const name = html("td", { "data-label": head[0] }, simulator.name);
    if (!run) return html("tr", {}, name, html("td", { colspan: "4" }, test.excluded[index] || "no outcome: not driven, or every attempt ended in an error"));
    const outcome = html("td", { "data-label": head[1], ...(run.failed ? { class: "failed" } : {}) }, verdict(run) + (run.message ? ` (${run.message})` : ""));
    const numbers = [run.fitness.toFixed(3), run.maxLateral.toFixed(3), run.seconds.toFixed(1)];
    return html("tr", {}, name, outcome, ...numbers.map((text, k) => html("td", { class: "number", "data-label": head[k + 2] }, text)));
  });
  const heads = head.map((text, index) => html("th", index > 1 ? { class: "number" } : {}, text));
  return html("table", { class: "outcomes stack" }, html("thead", {}, html("tr", {}, ...heads)), html("tbody", {}, ...rows));
}

/** Quote a word for a shell. */
const quoted = (word) => (/^[\w@%+=:,./-]+$/.test(word) ? word : `'${word.replaceAll("'", `'\\''`)}'`);

/** Commands that re-simulate a test: each recorded run from its bag, and its road on any simulator. */
function commandsOf(test) {
  const box = html("div", { class: "commands" }, html("h4", {}, "Drive it again"),
    html("p", { class: "hint" }, "Run these in the campaign folder, which holds this file. Re-simulating a bag repeats every recorded command; to drive the same road on another simulator or with another driver, write its road file first."));
  test.runs.forEach((run, index) => {
    if (run && run.bag) box.append(command(`ds bag redrive ${quoted(run.bag)} --video ${quoted(`${run.bag.split("/").at(-1)}.mp4`)}`, `again on ${data.simulators[index].name}, as recorded`));
  });
  box.append(command(`ds campaign roads . --test ${quoted(test.id)} > road.json`, "the road as a file"));
  for (const { name } of data.simulators) box.append(command(`ds drive --sim ${quoted(name)} --driver ${quoted(data.driver)} --road road.json --seed ${test.seed}${test.conditions ? ` --conditions ${test.conditions}` : ""}`, `the road on ${name}`));
  return box;
}

function command(text, what) {
  const copy = html("button", { type: "button", "aria-label": `Copy the command: ${what}`, title: what }, "Copy");
  const line = html("pre", { tabindex: "0" }, text);
  copy.addEventListener("click", async () => {
    try {
      await navigator.clipboard.writeText(text);
    } catch { // the clipboard is not available to local files in every browser
      getSelection().selectAllChildren(line);
      document.execCommand("copy");
    }
    copy.textContent = "Copied";
    setTimeout(() => { copy.textContent = "Copy"; }, 1500);
  });
  return html("div", { class: "command" }, line, copy);
}

function drivePictures(test) {
  const box = html("div", { class: "drive" }, html("h4", {}, "The drive, as the camera saw it"));
  const rows = data.pictures[test.id];
  if (!rows) {
    box.append(html("p", { class: "hint" }, `This file has pictures of ${Object.keys(data.pictures).length} of ${plural(data.tests.length, "test")}, the worst of each cell and others that failed, but not of this one.`));
    return box;
  }
  rows.forEach((drive, index) => {
    if (!drive) return;
    const name = data.simulators[index].name;
    const run = test.runs[index];
    const part = run.failed ? `the last seconds before it failed (${run.outcome})` : "from start to end";
    box.append(html("p", {}, html("b", {}, name), `, ${drive.note || part}`));
    box.append(html("div", { class: data.paired ? "strip paired" : "strip" }, ...drive.strip.map((at) => drive.frames[at]).map(([picture, words]) =>
      html("figure", {}, html("img", { src: `data:image/jpeg;base64,${picture}`, alt: `${name}, ${words}`, width: "240", height: data.paired ? "240" : "120" }), html("figcaption", {}, words)))));
  });
  return box;
}
