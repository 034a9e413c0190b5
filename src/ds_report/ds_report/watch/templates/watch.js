{# SPDX-License-Identifier: Apache-2.0 #}
"use strict";
(() => {
const data = { simulators: [], lane: 4, pictures: {}, paired: {{ paired | tojson }} };

{% include "page_elements.js" %}

{% include "report_replay.js" %}

const EVERY = 1000; // ms between two readings of the state
const HOLD = 20; // steps for which the end of a drive stays
const [LOW, HALF, HIGH] = {{ [palette.rgb(palette.PASS), palette.rgb(palette.BETWEEN), palette.rgb(palette.FAIL)] | tojson }};
const element = (id) => document.getElementById(id);
const players = new Map(); // simulator -> its card
let paused = matchMedia("(prefers-reduced-motion: reduce)").matches;

const duration = (s) => (s < 120 ? `${s.toFixed(0)} s` : s < 7200 ? `${(s / 60).toFixed(0)} min` : `${(s / 3600).toFixed(1)} h`);

function colourOf(share) {
  const [from, to, part] = share < 0.5 ? [LOW, HALF, 2 * share] : [HALF, HIGH, 2 * share - 1];
  return `rgb(${from.map((v, k) => Math.round(v + part * (to[k] - v))).join(" ")})`;
}

function showProgress(state) {
  const left = state.seconds_left === null ? "" : `, about ${duration(state.seconds_left)} left`;
  const words = {
    running: `Running${state.stage ? `: ${state.stage}` : ""}${left}`,
    done: "Done: the report is report.html in the campaign's folder",
    stopped: "Not running, and not whole: ds campaign resume continues it",
  };
  element("headline").textContent = words[state.state];
  element("progress").className = state.state;
  const bar = element("bar");
  bar.max = Math.max(state.total, state.done, 1);
  bar.value = state.done;
  const failed = state.simulators.map((s) => `${s.name}${s.role === "twin" ? " (twin)" : ""} ${s.failures} of ${s.tests} failed`);
  element("facts").textContent = [`${state.done} of at most ${state.total} drives`, plural(state.tests, "test"), ...failed,
    ...(state.excluded ? [`${state.excluded} excluded`] : []),
    ...(state.errors ? [`${plural(state.errors, "attempt")} ended in an error, the last one ${state.last_error}`] : [])].join(" · ");
}

function showNow(drives) {
  element("no-drives").hidden = drives.length > 0;
  element("drives").replaceChildren(...drives.map((drive) => {
    const said = drive.progress === null ? "; this engine does not say where the car is" : `, ${(100 * drive.progress).toFixed(0)}% of the road, ${Math.abs(drive.lateral).toFixed(2)} m ${drive.lateral >= 0 ? "right" : "left"}`;
    const words = html("span", {}, `for ${drive.seconds.toFixed(0)} s${said}`);
    const item = html("li", {}, html("b", {}, `${drive.test || "a new test"} on ${drive.simulator}`), words);
    if (drive.road) item.append(roadOf(drive));
    return item;
  }));
}

/** The road of a drive under way, with the car where the engine says. */
function roadOf({ road: [lx, ly, rx, ry], car, simulator }) {
  const label = car ? "The road from above, with the car" : "The road from above";
  const { node, place, size } = roadAbove({ lx, ly, rx, ry }, 6, { "aria-label": label });
  if (!car) return node;
  const at = data.simulators.find(({ name }) => name === simulator);
  const shape = carOf(at ? at.colour : "currentColor");
  place(shape, ...car, size / 45);
  node.append(shape);
  return node;
}

function showMaps(state) {
  const [across, up] = state.axes;
  if (!up) return;
  element("axes").textContent = `${across.title} goes to the right, ${up.title} upwards.`;
  element("grids").replaceChildren(...state.simulators.map((simulator) => gridOf(simulator, across, up, state.maps[simulator.name])));
}

function gridOf({ name, role }, across, up, cells) {
  const [w, h, left] = [44, 26, 52];
  const [columns, rows] = [across.labels.length, up.labels.length];
  const x = (bin) => left + w * (bin - across.low);
  const y = (bin) => h * (rows - 1 - (bin - up.low));
  const shapes = [svg("rect", { x: left, y: 0, width: w * columns, height: h * rows, class: "empty" })];
  for (const [i, j, tests, failures] of cells) {
    const dark = failures / tests > 0.8 ? " dark" : "";
    shapes.push(svg("rect", { x: x(i), y: y(j), width: w, height: h, fill: colourOf(failures / tests), class: "filled" }),
      svg("text", { x: x(i) + w / 2, y: y(j) + h / 2 + 4, class: `on-cell${dark}` }, `${failures}/${tests}`));
  }
  across.labels.forEach((label, k) => shapes.push(svg("text", { x: left + w * (k + 0.5), y: h * rows + 15, class: "axis" }, label)));
  up.labels.forEach((label, k) => shapes.push(svg("text", { x: left / 2, y: h * (rows - 1 - k) + h / 2 + 4, class: "axis" }, label)));
  const words = `${name}: ${plural(cells.length, "filled cell")}`;
  return html("figure", { class: "grid" }, html("figcaption", {}, html("b", {}, name), ` (${role}), ${plural(cells.length, "cell")}`),
    svg("svg", { viewBox: `0 0 ${left + w * columns + 4} ${h * rows + 22}`, style: `max-width: ${1.3 * (left + w * columns)}px`, role: "img", "aria-label": words }, ...shapes));
}

function showStages(stages) {
  const number = (value) => html("td", { class: "number" }, value === null ? "–" : String(value));
  document.querySelector("#stages tbody").replaceChildren(...stages.map((stage) =>
    html("tr", {}, html("td", {}, stage.name), html("td", {}, stage.state), number(stage.done), number(stage.expected), number(stage.failures))));
}

/** Shows a simulator's latest drive, and the next one when that has ended. */
class Player {
  constructor(index) {
    this.index = index;
    this.node = html("article", {}, html("h3", {}, data.simulators[index].name), html("p", { class: "hint" }, "No finished drive yet."));
    this.shown = "";
    this.loading = false;
    this.t = 0;
    this.hold = 0;
  }

  async next() {
    const { name, latest } = data.simulators[this.index];
    const playing = this.parts && !paused && this.t < this.end + HOLD * REPLAY_STEP;
    if (!latest || latest === this.shown || this.loading || playing) return;
    this.loading = true;
    if (!this.parts) this.node.querySelector(".hint").textContent = `Rendering ${latest}`;
    try {
      const answer = await fetch(`drive.json?${new URLSearchParams({ test: latest, simulator: name })}`);
      if (!answer.ok) return;
      const test = await answer.json();
      data.pictures[test.id] = [];
      data.pictures[test.id][this.index] = test.pictures;
      const run = test.runs[this.index];
      this.shown = latest;
      if (run.x.length) this.open(test, run);
      delete data.pictures[test.id];
    } finally {
      this.loading = false;
    }
  }

  open(test, run) {
    const card = replayCard(test, run, this.index);
    const map = replayMap(test, [card]);
    this.parts = [card, map];
    this.end = run.time.at(-1);
    this.t = paused ? this.end : 0;
    this.node.className = "replay";
    this.node.replaceChildren(html("h3", {}, `${test.id} on ${data.simulators[this.index].name}`), map.node, card.node);
    this.show();
  }

  show() {
    for (const part of this.parts) part.show(Math.min(this.t, this.end));
  }

  tick() {
    if (!this.parts || this.t >= this.end + HOLD * REPLAY_STEP) return;
    this.t += REPLAY_STEP;
    if (this.t < this.end + REPLAY_STEP) this.show();
  }
}

async function refresh() {
  if (document.hidden && document.body.dataset.ready) return;
  let state;
  try {
    const answer = await fetch("state.json");
    state = await answer.json();
  } catch {
    state = { problem: "the server does not answer: is ds watch still running?" };
  }
  element("problem").hidden = !state.problem;
  element("problem").textContent = state.problem || "";
  if (!state.simulators) return;
  data.lane = state.lane;
  data.simulators = state.simulators;
  showProgress(state);
  showNow(state.now);
  showMaps(state);
  showStages(state.stages);
  state.simulators.forEach(({ name }, index) => {
    if (!players.has(name)) {
      players.set(name, new Player(index));
      element("cards").append(players.get(name).node);
    }
    players.get(name).next().catch(() => {});
  });
  document.body.dataset.ready = "true"; // for tests
}

function showPaused() {
  element("pause").textContent = paused ? "Play" : "Pause";
  element("pause").setAttribute("aria-pressed", String(paused));
}
element("pause").addEventListener("click", () => {
  paused = !paused;
  showPaused();
});
showPaused();
setInterval(() => {
  if (!paused && !document.hidden) for (const player of players.values()) player.tick();
}, 1000 * REPLAY_STEP);
(async function loop() {
  for (;;) {
    await refresh();
    await new Promise((resolve) => { setTimeout(resolve, EVERY); });
  }
})();
})();
