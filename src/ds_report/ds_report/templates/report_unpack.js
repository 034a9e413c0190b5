{# SPDX-License-Identifier: Apache-2.0 #}
// ---- lines of tests, unpacked when a cell is opened ---------------------------------------------------------------
// Format of `ds_report.page_encoding.pack`: deflate over the bytes of uint32 numbers, all lowest bytes
// first, which encode the second differences of one column after the other: 0, -1, 1, -2, 2 as 0, 1, 2, 3, 4.

async function unpack(text) {
  const bytes = Uint8Array.from(atob(text), (character) => character.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  const planes = new Uint8Array(await new Response(stream).arrayBuffer());
  const count = planes.length / 4;
  const numbers = new Int32Array(count);
  for (let i = 0; i < count; i += 1) {
    const code = planes[i] | (planes[count + i] << 8) | (planes[2 * count + i] << 16) | (planes[3 * count + i] << 24);
    numbers[i] = (code >>> 1) ^ -(code & 1);
  }
  return numbers;
}

/** Return a function that decodes the next column at every call, in m (or shares of full lock). */
function columnsOf(numbers) {
  let next = 0;
  return (length) => {
    const values = new Array(length);
    let value = 0;
    let step = 0;
    for (let i = 0; i < length; i += 1) {
      step += numbers[next + i];
      value += step;
      values[i] = value / data.units;
    }
    next += length;
    return values;
  };
}

function distancesAlong(x, y) {
  const out = [];
  x.forEach((_, i) => out.push(i ? out[i - 1] + Math.hypot(x[i] - x[i - 1], y[i] - y[i - 1]) : 0));
  return out;
}

/** Unpack the tests of one cell: [{id, ..., road, runs}], the worst test first. */
async function testsOf(placeIndex) {
  const column = columnsOf(await unpack(data.lines[placeIndex]));
  const found = data.places[placeIndex][1].map((index) => {
    const [id, sibling, run, number, seed, roadId, length, curvature, turns, points, runs] = data.tests[index];
    const [cx, cy, rx, ry] = [column(points), column(points), column(points), column(points)];
    const road = { id: roadId, length, curvature, turns, cx, cy, rx, ry };
    road.lx = cx.map((x, i) => 2 * x - rx[i]);
    road.ly = cy.map((y, i) => 2 * y - ry[i]);
    const drives = runs.map((facts) => {
      if (!facts) return null;
      const [outcome, failed, fitness, maxLateral, seconds, kept, steered, message, bag] = facts;
      const [x, y, lateral] = kept ? [column(kept), column(kept), column(kept)] : [[], [], []];
      const steering = steered ? column(kept) : [];
      // Kept frames are `data.frame` seconds apart, but the last one may come sooner.
      const time = x.map((_, i) => Math.min(i * data.frame, seconds));
      return { outcome, failed: Boolean(failed), fitness, maxLateral, seconds, message, bag, x, y, lateral, steering, time, distance: distancesAlong(x, y) };
    });
    const conditions = data.conditions ? data.conditions[index] : "";
    const excluded = (data.excluded && data.excluded[id]) || [];
    return { id, conditions, excluded, sibling: data.simulators[sibling].name, run, number, seed, road, runs: drives };
  });
  const failures = (test) => test.runs.filter((run) => run && run.failed).length;
  const worst = (test) => Math.min(...test.runs.map((run) => (run ? run.fitness : Infinity)));
  return found.sort((a, b) => failures(b) - failures(a) || worst(a) - worst(b) || (a.id < b.id ? -1 : 1));
}
