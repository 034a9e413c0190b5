{# SPDX-License-Identifier: Apache-2.0 #}
// ---- replay of one test: every simulator's drive at one moment ----------------------------------------------------
const REPLAY_STEP = 0.1; // s: drives are kept at 10 frames a second
const GAUGE = 200; // width of a gauge in its own units

const verdict = (run) => (!run ? "– no outcome" : run.failed ? `✗ ${run.outcome}` : `✓ ${run.outcome}`);

/** Where a run that failed did so: the first frame outside the lane, or the last one. */
function failure(run) {
  if (!run || !run.failed || !run.x.length) return -1;
  const outside = run.lateral.findIndex((value) => Math.abs(value) > data.lane / 2);
  return outside >= 0 ? outside : run.x.length - 1;
}

/** Index of the last of increasing times that is not later than t; 0 if all are. */
function lastBefore(times, t) {
  let low = 0;
  let high = times.length - 1;
  while (low < high) {
    const middle = Math.ceil((low + high) / 2);
    if (times[middle] <= t + 1e-9) low = middle;
    else high = middle - 1;
  }
  return low;
}

function replayOf(test, { title = "Replay", playing = false } = {}) {
  const box = html("div", { class: "replay" }, html("h4", {}, title));
  const parts = test.runs.map((run, index) => run && run.x.length && replayCard(test, run, index)).filter(Boolean);
  if (!parts.length) {
    box.append(html("p", { class: "hint" }, "Nothing was driven."));
    return box;
  }
  // Up to the next step of the slider, so that its end shows the last frame of every drive.
  const end = REPLAY_STEP * Math.ceil(Math.max(...parts.map(({ run }) => run.time.at(-1))) / REPLAY_STEP - 1e-9);
  const failures = parts.map(({ run }) => run).filter((run) => run.failed).map((run) => run.time[failure(run)]);
  const slider = html("input", { type: "range", min: "0", max: end.toFixed(1), step: REPLAY_STEP, "aria-label": "Time of the replay" });
  const play = html("button", { type: "button", "aria-pressed": "false" }, "Play");
  const clock = html("output", { class: "clock" });
  const map = replayMap(test, parts);
  const timeline = replayTimeline(parts, end);

  function show(t) {
    slider.value = t;
    clock.textContent = `${Number(slider.value).toFixed(1)} of ${end.toFixed(1)} s`;
    slider.setAttribute("aria-valuetext", `${Number(slider.value).toFixed(1)} s. ${parts.map((part) => part.show(t)).join(". ")}`);
    map.show(t);
    timeline.show(t);
  }
  let timer = 0;
  function stop() {
    clearInterval(timer);
    timer = 0;
    play.textContent = "Play";
    play.setAttribute("aria-pressed", "false");
  }
  const atEnd = () => Number(slider.value) >= end - REPLAY_STEP / 2;
  function start() {
    if (atEnd()) show(0);
    play.textContent = "Pause";
    play.setAttribute("aria-pressed", "true");
    timer = setInterval(() => {
      if (!box.isConnected || atEnd()) return stop(); // another test was opened
      show(Number(slider.value) + REPLAY_STEP);
    }, 1000 * REPLAY_STEP);
  }
  play.addEventListener("click", () => (timer ? stop() : start()));
  slider.addEventListener("input", () => show(Number(slider.value)));
  timeline.onTime((t) => { stop(); show(t); });
  box.append(
    html("p", { class: "hint" }, "All drives at the same time since their start: drag the slider, or focus it and press the arrow keys, Home or End. Below it, lateral position with the lane's edges, and steering; left is up. ",
      ...parts.flatMap(({ index }) => [html("b", { style: `color:${data.simulators[index].colour}` }, `— ${data.simulators[index].name}`), " "])),
    html("div", { class: "player" }, play, slider, clock), timeline.node,
    html("div", { class: "moment" }, map.node, html("div", { class: "views" }, ...parts.map(({ node }) => node))));
  show(failures.length && !playing ? Math.min(...failures) : 0);
  if (playing) setTimeout(start); // when it is on the page
  return box;
}

/** One simulator's drive: camera, place in the lane and steering; show(t) returns them in words. */
function replayCard(test, run, index) {
  const { name, colour } = data.simulators[index];
  const drive = (data.pictures[test.id] || [])[index];
  const times = drive ? drive.times : [];
  const image = html("img", { width: "240", height: data.paired ? "240" : "120", alt: "" });
  const caption = html("span", { class: "hint" });
  const reach = 1.5 * (data.lane / 2);
  const lateral = gauge([-data.lane / 2, data.lane / 2], reach, colour);
  const steering = gauge([], 1, colour);
  const [where, wheel] = [html("span"), html("span")];
  const node = html("figure", { class: data.paired ? "view paired" : "view" }, html("figcaption", {}, html("b", {}, name), " ", caption),
    times.length ? image : html("div", { class: "nopicture" }, drive && drive.note ? drive.note : "no pictures in this file"),
    lateral.node, where, steering.node, wheel);
  return {
    run, index, node,
    show(t) {
      const at = lastBefore(run.time, t);
      const ended = t >= run.time.at(-1) - 1e-9;
      const distance = data.lane / 2 - Math.abs(run.lateral[at]);
      caption.textContent = ended ? verdict(run) : `${run.distance[at].toFixed(0)} m`;
      caption.classList.toggle("failed", ended && run.failed);
      if (times.length) {
        const picture = lastBefore(times, t);
        if (image.dataset.picture !== String(picture)) {
          image.dataset.picture = picture;
          image.src = `data:image/jpeg;base64,${drive.frames[picture][0]}`;
          image.alt = `${name}, ${drive.frames[picture][1]}`;
          image.title = drive.frames[picture][1];
        }
      }
      lateral.show(run.lateral[at]);
      const edge = distance < 0 ? `${(-distance).toFixed(2)} m outside the lane` : `${distance.toFixed(2)} m to the lane's edge`;
      where.textContent = `${Math.abs(run.lateral[at]).toFixed(2)} m ${run.lateral[at] >= 0 ? "right" : "left"}, ${edge}`;
      where.classList.toggle("failed", distance < 0);
      if (run.steering.length) steering.show(run.steering[at]);
      wheel.textContent = run.steering.length ? `steering ${Math.abs(run.steering[at]).toFixed(2)} ${run.steering[at] >= 0 ? "right" : "left"}` : "steering not recorded";
      return `${name}: ${where.textContent}, ${wheel.textContent}${ended ? `, ${run.outcome}` : ""}`;
    },
  };
}

/** A horizontal scale from -reach, left, to reach, right, with a mark; between two edges it is the lane. */
function gauge(edges, reach, colour) {
  const at = (value) => (GAUGE / 2) * (1 + Math.max(-1, Math.min(1, value / reach)) * 0.96);
  const mark = svg("circle", { r: 7, cy: 13, fill: colour, class: "mark" });
  const bar = svg("line", { x1: GAUGE / 2, y1: 13, y2: 13, stroke: colour, "stroke-width": 6 });
  const lane = edges.length ? [svg("rect", { x: at(edges[0]), width: at(edges[1]) - at(edges[0]), y: 2, height: 22, class: "lane" })] : [svg("rect", { x: at(-reach), width: at(reach) - at(-reach), y: 10, height: 6, class: "lane" })];
  const lines = edges.map((edge) => svg("line", { x1: at(edge), x2: at(edge), y1: 0, y2: 26, class: "edge" }));
  const middle = svg("line", { x1: GAUGE / 2, x2: GAUGE / 2, y1: 4, y2: 22, class: "middle" });
  const node = svg("svg", { viewBox: `0 0 ${GAUGE} 26`, class: "gauge", "aria-hidden": "true" }, ...lane, ...lines, middle, ...(edges.length ? [] : [bar]), mark);
  return {
    node,
    show(value) {
      mark.setAttribute("cx", at(value));
      bar.setAttribute("x2", at(value));
    },
  };
}

/** A road from above with room for further points: the picture, and what places lines and cars in it. */
function roadAbove({ lx, ly, rx, ry, cx = [], cy = [] }, margin, attributes, further = { xs: [], ys: [] }) {
  const [xs, ys] = [[...lx, ...rx, ...further.xs], [...ly, ...ry, ...further.ys]];
  const [left, top] = [Math.min(...xs) - margin, Math.max(...ys) + margin];
  const [width, height] = [Math.max(...xs) + margin - left, top - Math.min(...ys) + margin];
  const points = (x, y, end = x.length) => x.slice(0, end).map((v, i) => `${(v - left).toFixed(1)},${(top - y[i]).toFixed(1)}`).join(" ");
  const node = svg("svg", { viewBox: `0 0 ${width.toFixed(1)} ${height.toFixed(1)}`, role: "img", ...attributes },
    svg("polygon", { points: points([...lx, ...rx.slice().reverse()], [...ly, ...ry.slice().reverse()]), class: "lane" }),
    ...[[lx, ly, "edge"], [rx, ry, "edge"], [cx, cy, "centre"]].map(([x, y, kind]) => svg("polyline", { points: points(x, y), class: kind })));
  const place = (car, x, y, yaw, scale) => car.setAttribute("transform", `translate(${(x - left).toFixed(1)} ${(top - y).toFixed(1)}) rotate(${((-180 / Math.PI) * yaw).toFixed(0)}) scale(${scale.toFixed(2)})`);
  return { node, points, place, size: Math.max(width, height) };
}
const carOf = (colour) => svg("path", { d: "M 2.4 0 L -1.8 1.5 L -1 0 L -1.8 -1.5 Z", fill: colour, class: "car" });

/** The road from above, what is driven of every drive, and the cars. */
function replayMap(test, parts) {
  const further = { xs: parts.flatMap(({ run }) => run.x), ys: parts.flatMap(({ run }) => run.y) };
  const label = "The road from above, with every car at this moment";
  const { node, points, place, size } = roadAbove(test.road, 8, { class: "above", "aria-label": label }, further);
  const cars = parts.map(({ run, index }) => {
    const { colour } = data.simulators[index];
    const trail = svg("polyline", { fill: "none", stroke: colour, "stroke-width": size / 160 });
    return { run, trail, car: carOf(colour) };
  });
  node.append(...cars.map(({ trail }) => trail), ...cars.map(({ car }) => car));
  return {
    node,
    show(t) {
      for (const { run, trail, car } of cars) {
        const at = lastBefore(run.time, t);
        trail.setAttribute("points", points(run.x, run.y, at + 1));
        const [from, to] = at ? [at - 1, at] : [0, Math.min(1, run.x.length - 1)];
        place(car, run.x[at], run.y[at], Math.atan2(run.y[to] - run.y[from], run.x[to] - run.x[from]), size / 62);
      }
    },
  };
}

/** Lateral position and steering over time, to click and drag in. */
function replayTimeline(parts, end) {
  const [width, high, gap, low] = [1000, 90, 8, 50];
  const half = data.lane / 2;
  const reach = Math.max(1.15 * half, ...parts.flatMap(({ run }) => run.lateral.map((v) => 1.05 * Math.abs(v))));
  const x = (t) => (width * t) / (end || 1);
  const place = (value) => (high / 2) * (1 + value / reach); // right is down, as the driver's left is up
  const lock = (value) => high + gap + (low / 2) * (1 + value);
  const line = (run, values, y, index) => svg("polyline", { points: values.map((v, i) => `${x(run.time[i]).toFixed(1)},${y(v).toFixed(1)}`).join(" "), fill: "none", stroke: data.simulators[index].colour, class: "drawn" });
  const cursor = svg("line", { y1: 0, y2: high + gap + low, class: "cursor" });
  const node = svg("svg", { viewBox: `0 0 ${width} ${high + gap + low}`, preserveAspectRatio: "none", class: "timeline", role: "img", "aria-label": "Above, every drive's lateral position over time, left is up, with the lane's edges; below, its steering" },
    svg("rect", { x: 0, width, y: place(-half), height: place(half) - place(-half), class: "lane" }),
    ...[-half, half].map((edge) => svg("line", { x1: 0, x2: width, y1: place(edge), y2: place(edge), class: "edge" })),
    svg("rect", { x: 0, width, y: high + gap, height: low, class: "lane" }),
    svg("line", { x1: 0, x2: width, y1: lock(0), y2: lock(0), class: "middle" }),
    ...parts.map(({ run, index }) => line(run, run.lateral, place, index)),
    ...parts.map(({ run, index }) => line(run, run.steering, lock, index)), cursor);
  return {
    node,
    show(t) {
      cursor.setAttribute("x1", x(t));
      cursor.setAttribute("x2", x(t));
    },
    onTime(action) {
      const chosen = (event) => {
        const box = node.getBoundingClientRect();
        action(Math.max(0, Math.min(end, (end * (event.clientX - box.left)) / box.width)));
      };
      node.addEventListener("pointerdown", (event) => { node.setPointerCapture(event.pointerId); chosen(event); });
      node.addEventListener("pointermove", (event) => { if (event.buttons) chosen(event); });
    },
  };
}
