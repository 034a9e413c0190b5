"use strict";
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const SVG = document.querySelector("svg").namespaceURI;
  const DASHES = ["", "9 4", "2 3", "10 3 2 3", "5 2"];
  const FIRST_TESTS = 6;
  const key = (turns, curvature) => `${turns}-${curvature}`;
  const plural = (n, thing) => `${n} ${thing}${n === 1 ? "" : "s"}`;
  // Where a bin of an axis begins, in the unit of its title.
  const label = (axis, bin) => ((bin * axis.width) * axis.unit).toFixed(axis.unit === 1 ? 0 : 2);
  const place = (turns, curvature) => data.axes.map((axis, i) => `${axis.title} ${label(axis, [turns, curvature][i])}`).join("; ");
  const range = (low, high) => Array.from({ length: high - low + 1 }, (_, i) => low + i);

  function fill(node, attributes, children) {
    for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
    node.append(...children);
    return node;
  }
  const html = (tag, attributes = {}, ...children) => fill(document.createElement(tag), attributes, children);
  const svg = (tag, attributes = {}, ...children) => fill(document.createElementNS(SVG, tag), attributes, children);

  // ---- the feature maps -------------------------------------------------------------------------------------------
  const turnsCounts = range(...data.turns);
  const curvatures = range(...data.curvature).reverse();
  const values = {}; // map name -> cell key -> [turns, curvature, tests, failures, probability, quality]
  const places = {}; // cell key -> its <td> in every map
  for (const [name, map] of Object.entries(data.maps)) {
    values[name] = Object.fromEntries(map.cells.map((cell) => [key(cell[0], cell[1]), cell]));
  }
  const valueOf = (cell, value) => cell[value === "probability" ? 4 : 5];
  let chosen = null;

  function describe(cell, value) {
    if (!cell) return "no test";
    const failures = cell[3] === null ? plural(cell[2], "test") : `${cell[3]} of ${plural(cell[2], "test")} failed`;
    return `${data.values[value]} ${valueOf(cell, value).toFixed(2)}, ${failures}`;
  }

  function tableCell(name, value, turns, curvature) {
    const cell = values[name][key(turns, curvature)];
    const text = `${place(turns, curvature)}: ${describe(cell, value)}`;
    const td = html("td", { tabindex: "-1", title: text, "aria-label": text, "data-cell": key(turns, curvature) });
    if (cell) {
      const [colour, ink] = data.scale[Math.round(100 * valueOf(cell, value))];
      td.style.background = colour;
      td.style.color = ink;
      td.append(valueOf(cell, value).toFixed(2), html("small", {}, String(cell[2])));
    } else {
      td.className = "empty";
    }
    (places[key(turns, curvature)] ??= []).push(td);
    return td;
  }

  function mapFigure(name, value) {
    const title = `${data.maps[name].title}: ${data.values[value]}`;
    const table = html("table", { role: "grid", "aria-label": `${title}; columns are ${data.axes[0].title}, rows ${data.axes[1].title}` });
    const top = html("th", { class: "name", colspan: turnsCounts.length + 1 }, data.axes[1].title);
    const widths = [html("col", { style: "width: 34px" }), ...turnsCounts.map(() => html("col"))];
    table.append(html("colgroup", {}, ...widths), html("thead", {}, html("tr", {}, top)));
    const body = html("tbody");
    for (const curvature of curvatures) {
      const row = html("tr", {}, html("th", { scope: "row" }, label(data.axes[1], curvature)));
      for (const turns of turnsCounts) row.append(tableCell(name, value, turns, curvature));
      body.append(row);
    }
    const feet = turnsCounts.map((turns) => html("th", { scope: "col", class: "name" }, label(data.axes[0], turns)));
    const axis = html("th", { class: "name", colspan: turnsCounts.length }, data.axes[0].title);
    table.append(body, html("tfoot", {}, html("tr", {}, html("th"), ...feet), html("tr", {}, html("th"), axis)));
    return html("figure", { class: "map" }, html("figcaption", {}, data.maps[name].title), table);
  }

  function eachPlace(cellKey, change) {
    for (const td of places[cellKey] ?? []) change(td);
  }

  const STEPS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
  function onKey(event) {
    const td = event.target.closest("td[data-cell]");
    if (!td) return;
    const [turns, curvature] = td.dataset.cell.split("-").map(Number);
    if (event.key === "Enter" || event.key === " ") {
      event.preventDefault();
      choose(turns, curvature);
      return;
    }
    const step = STEPS[event.key];
    if (!step) return;
    event.preventDefault();
    const next = td.closest("table").querySelector(`td[data-cell="${key(turns + step[0], curvature + step[1])}"]`);
    if (!next) return;
    choose(turns + step[0], curvature + step[1]);
    next.focus();
  }

  // ---- the chosen cell --------------------------------------------------------------------------------------------
  const panel = document.getElementById("cell");

  function choose(turns, curvature, remember = true) {
    if (!places[key(turns, curvature)]) return;
    if (chosen) eachPlace(chosen, (td) => { td.classList.remove("chosen"); td.tabIndex = -1; td.removeAttribute("aria-selected"); });
    chosen = key(turns, curvature);
    eachPlace(chosen, (td) => { td.classList.add("chosen"); td.tabIndex = 0; td.setAttribute("aria-selected", "true"); });
    if (remember) history.replaceState(null, "", `#cell=${chosen}`);
    showCell(turns, curvature);
  }

  function showCell(turns, curvature) {
    const tests = data.tests.filter((test) => test.cell[0] === turns && test.cell[1] === curvature);
    const failures = (test) => test.runs.filter((run) => run && run.failed).length;
    const worst = (test) => Math.min(...test.runs.map((run) => (run ? run.fitness : Infinity)));
    tests.sort((a, b) => failures(b) - failures(a) || worst(a) - worst(b));
    panel.replaceChildren(
      html("h3", { "aria-live": "polite" }, `${place(turns, curvature)}: ${plural(tests.length, "test")}`),
      tests.length ? cellTable(key(turns, curvature)) : html("p", {}, "No test has such a road, so nothing is known here."),
    );
    if (!tests.length) return;
    panel.append(keys());
    showTests(tests, 0);
    panel.scrollTop = 0;
  }

  function showTests(tests, from) {
    for (const test of tests.slice(from, from + FIRST_TESTS)) panel.append(testCard(test));
    const rest = tests.length - from - FIRST_TESTS;
    if (rest <= 0) return;
    const more = html("button", { type: "button" }, `Show ${Math.min(rest, FIRST_TESTS)} more of ${plural(rest, "test")}`);
    more.addEventListener("click", () => {
      more.remove();
      showTests(tests, from + FIRST_TESTS);
    });
    panel.append(more);
  }

  function cellTable(cellKey) {
    const head = ["map", "failed", "failure probability", "lack of quality"];
    const rows = data.compared.map((name) => {
      const cell = values[name][cellKey];
      const failed = !cell ? "no test" : cell[3] === null ? "–" : `${cell[3]} of ${cell[2]}`;
      const numbers = cell ? [cell[4].toFixed(2), cell[5].toFixed(2)] : ["–", "–"];
      return html("tr", {}, html("td", {}, data.maps[name].title), ...[failed, ...numbers].map((text) => html("td", { class: "number" }, text)));
    });
    const heads = head.map((text, index) => html("th", index ? { class: "number" } : {}, text));
    return html("table", {}, html("thead", {}, html("tr", {}, ...heads)), html("tbody", {}, ...rows));
  }

  function stroke(index) {
    return { fill: "none", stroke: data.simulators[index].colour, "stroke-width": 2.2, "stroke-dasharray": DASHES[index % DASHES.length], "vector-effect": "non-scaling-stroke", "stroke-linejoin": "round" };
  }

  function sample(index) {
    return svg("svg", { viewBox: "0 0 34 10", "aria-hidden": "true" }, svg("line", { x1: 0, y1: 5, x2: 34, y2: 5, ...stroke(index) }));
  }

  function keys() {
    const list = html("ul", { class: "keys" });
    data.simulators.forEach((simulator, index) => list.append(html("li", {}, sample(index), `${simulator.name} (${simulator.role})`)));
    const cross = svg("svg", { viewBox: "-17 -5 34 10", "aria-hidden": "true" }, mark(0, 0, 4, "#1e2329"));
    list.append(html("li", {}, cross, "where the run failed"));
    return list;
  }

  // ---- one test ---------------------------------------------------------------------------------------------------
  /** Absolute points, m, from first point and steps in cm. */
  function points(steps) {
    const out = [];
    let x = 0;
    let y = 0;
    for (let i = 0; i < steps.length; i += 2) {
      x += steps[i];
      y += steps[i + 1];
      out.push([x / 100, y / 100]);
    }
    return out;
  }
  const path = (line, project) => line.map((point) => project(point).map((v) => v.toFixed(2)).join(",")).join(" ");

  function mark(x, y, size, colour) {
    const d = `M${x - size},${y - size}L${x + size},${y + size}M${x - size},${y + size}L${x + size},${y - size}`;
    const line = (paint, width) => svg("path", { d, fill: "none", stroke: paint, "stroke-width": width, "stroke-linecap": "round", "vector-effect": "non-scaling-stroke" });
    return svg("g", {}, line("#fff", 6), line(colour, 3));
  }

  function testCard(test) {
    const road = data.roads[test.road];
    const origin = `road ${test.road}, ${road.length} m, ${plural(road.turns, "turn")}, largest curvature ${road.curvature} 1/m; found by the search on ${test.sibling}, run ${test.run}, test ${test.number}; seed ${test.seed}`;
    const head = ["simulator", "outcome", "fitness, m", "max lateral position, m", "time, s"];
    const rows = data.simulators.map((simulator, index) => {
      const run = test.runs[index];
      const name = html("td", {}, simulator.name);
      if (!run) return html("tr", {}, name, html("td", { colspan: 4 }, "not driven, or ended in an error"));
      const outcome = html("td", run.failed ? { class: "failed" } : {}, run.failed ? `✗ ${run.outcome}` : `✓ ${run.outcome}`);
      if (run.message) outcome.title = run.message;
      const numbers = [run.fitness.toFixed(3), run.maxLateral.toFixed(3), run.seconds.toFixed(1)];
      return html("tr", {}, name, outcome, ...numbers.map((text) => html("td", { class: "number" }, text)));
    });
    const heads = head.map((text, index) => html("th", index > 1 ? { class: "number" } : {}, text));
    const table = html("table", {}, html("thead", {}, html("tr", {}, ...heads)), html("tbody", {}, ...rows));
    return html("article", { class: "test" }, html("h4", {}, test.id), html("p", {}, origin), roadPicture(test, road), lateralPicture(test, road), table);
  }

  /** The road from above, with every trajectory; the road's y points up. */
  function roadPicture(test, road) {
    const left = points(road.left);
    const right = points(road.right);
    const paths = test.runs.map((run) => (run ? points(run.path) : []));
    const all = [...left, ...right, ...paths.flat()];
    const margin = 5;
    const lowX = Math.min(...all.map((p) => p[0])) - margin;
    const highX = Math.max(...all.map((p) => p[0])) + margin;
    const lowY = Math.min(...all.map((p) => p[1])) - margin;
    const highY = Math.max(...all.map((p) => p[1])) + margin;
    const project = ([x, y]) => [x - lowX, highY - y];
    const size = Math.max(highX - lowX, highY - lowY);
    const picture = svg("svg", { class: "road", role: "img", viewBox: `0 0 ${highX - lowX} ${highY - lowY}`, "aria-label": `Road of test ${test.id} with the trajectories of every simulator` });
    const line = (of, paint, width) => svg("polyline", { points: path(of, project), fill: "none", stroke: paint, "stroke-width": width, "vector-effect": "non-scaling-stroke" });
    picture.append(
      svg("polygon", { points: path([...left, ...right.slice().reverse()], project), fill: "#dcdee3" }),
      line(left, "#70757d", 1.4), line(right, "#70757d", 1.4), line(points(road.centre), "#b58900", 1.2),
    );
    paths.forEach((one, index) => one.length && picture.append(svg("polyline", { points: path(one, project), ...stroke(index) })));
    const lane = right[0].map((v, k) => (v + points(road.centre)[0][k]) / 2);
    picture.append(svg("circle", { cx: project(lane)[0], cy: project(lane)[1], r: size / 110, fill: "#1e2329" }));
    const [x, y] = project(lane);
    const side = x > 0.8 * (highX - lowX) ? -1 : 1;
    const anchor = side > 0 ? "start" : "end";
    picture.append(svg("text", { x: x + (side * size) / 60, y: y + size / 30, "text-anchor": anchor, style: `font-size:${size / 32}px` }, "start"));
    test.runs.forEach((run, index) => {
      if (run && run.failedAt) picture.append(mark(...project(run.failedAt.map((v) => v / 100)), size / 70, data.simulators[index].colour));
    });
    const bar = size > 120 ? 20 : 10;
    const base = highY - lowY - 2.5;
    picture.append(
      svg("line", { x1: 2.5, y1: base, x2: 2.5 + bar, y2: base, stroke: "#1e2329", "stroke-width": 2, "vector-effect": "non-scaling-stroke" }),
      svg("text", { x: 2.5, y: base - 1.5, style: `font-size:${size / 32}px` }, `${bar} m`),
    );
    return picture;
  }

  /** Lateral position over the distance driven, seen like the lane: its left border is at the top. */
  function lateralPicture(test, road) {
    const lines = test.runs.map((run) => (run ? points(run.lateral) : []));
    const half = road.halfLane / 100;
    const all = lines.flat();
    const end = Math.max(10, ...all.map((p) => p[0]));
    const reach = Math.max(1.15 * half, ...all.map((p) => 1.05 * Math.abs(p[1])));
    const [x0, width, height] = [46, 400, 96];
    const project = ([s, lateral]) => [x0 + (s / end) * (width - x0 - 4), 2 + ((lateral + reach) / (2 * reach)) * height];
    const picture = svg("svg", { class: "lateral", role: "img", viewBox: `0 0 ${width} ${height + 16}`, "aria-label": `Lateral position over distance, test ${test.id}` });
    const level = (at, dashes) => svg("line", { x1: x0, x2: width - 4, y1: project([0, at])[1], y2: project([0, at])[1], stroke: "#70757d", "stroke-dasharray": dashes });
    const top = project([0, -half])[1];
    picture.append(
      svg("rect", { x: x0, y: top, width: width - x0 - 4, height: project([0, half])[1] - top, fill: "#dcdee3" }),
      level(-half, ""), level(half, ""), level(0, "3 4"),
      svg("text", { x: x0 - 4, y: top + 4, "text-anchor": "end" }, `left ${half} m`),
      svg("text", { x: x0 - 4, y: project([0, half])[1] + 4, "text-anchor": "end" }, `right`),
      svg("text", { x: x0, y: height + 14 }, "lateral position in the lane over distance driven"),
      svg("text", { x: width - 4, y: height + 14, "text-anchor": "end" }, `${end.toFixed(0)} m`),
    );
    lines.forEach((one, index) => one.length && picture.append(svg("polyline", { points: path(one, project), ...stroke(index), "stroke-width": 1.6 })));
    test.runs.forEach((run, index) => {
      if (run && run.failedAt) picture.append(mark(...project(run.failedAt.slice(2).map((v) => v / 100)), 3.5, data.simulators[index].colour));
    });
    return picture;
  }

  // ---- start ------------------------------------------------------------------------------------------------------
  for (const scale of document.querySelectorAll("svg.scale")) {
    data.scale.forEach(([colour], index) => scale.append(svg("rect", { x: index, y: 0, width: 1, height: 8, fill: colour, "shape-rendering": "crispEdges" })));
  }
  const explorer = document.querySelector(".groups");
  for (const group of explorer.querySelectorAll(".maps")) {
    group.style.setProperty("--maps", Math.min(6, data[group.dataset.maps].length));
    for (const name of data[group.dataset.maps]) group.append(mapFigure(name, group.dataset.value));
  }
  explorer.style.setProperty("--columns", turnsCounts.length);
  explorer.addEventListener("keydown", onKey);
  explorer.addEventListener("click", (event) => {
    const td = event.target.closest("td[data-cell]");
    if (td) choose(...td.dataset.cell.split("-").map(Number));
  });
  for (const [kind, hot] of [["mouseover", true], ["mouseout", false]]) {
    explorer.addEventListener(kind, (event) => {
      const td = event.target.closest("td[data-cell]");
      if (td) eachPlace(td.dataset.cell, (place) => place.classList.toggle("hot", hot));
    });
  }
  function chooseFromAddress() {
    const found = /^#cell=(\d+)-(\d+)$/.exec(location.hash);
    if (!found || !places[key(Number(found[1]), Number(found[2]))]) return false;
    choose(Number(found[1]), Number(found[2]));
    document.getElementById("maps").scrollIntoView({ behavior: "instant" });
    return true;
  }
  window.addEventListener("hashchange", chooseFromAddress);
  if (!chooseFromAddress() && data.selected) choose(...data.selected, false);
})();
