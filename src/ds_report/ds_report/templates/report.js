{# SPDX-License-Identifier: Apache-2.0 #}
"use strict";
(() => {
const data = JSON.parse(document.getElementById("data").textContent);
{% include "page_elements.js" %}

{% include "report_unpack.js" %}

{% include "report_maps.js" %}

{% include "report_replay.js" %}

{% include "report_cell.js" %}

// ---- start --------------------------------------------------------------------------------------------------------
function later(action, milliseconds) {
  let timer = 0;
  return () => {
    clearTimeout(timer);
    timer = setTimeout(action, milliseconds);
  };
}

/** Open the cell, and the test, that the address names; null if it names none. */
function openFromAddress() {
  const found = /^#cell=([\d-]+)(?:&test=(.+))?$/.exec(location.hash);
  if (found && found[1] in placeIndex) {
    document.getElementById(found[2] ? "cell" : "maps").scrollIntoView({ behavior: "instant" });
    return choose(found[1], { testId: found[2] ? decodeURIComponent(found[2]) : null });
  }
  return null;
}

/** Show the worst test on the first screen; it plays at once, unless the reader wants no motion. */
async function showWorst(box) {
  const index = data.tests.findIndex(([id]) => id === box.dataset.worst);
  const place = data.places.findIndex(([, members]) => members.includes(index));
  if (place < 0) return;
  const test = (await testsOf(place)).find(({ id }) => id === box.dataset.worst);
  const playing = !matchMedia("(prefers-reduced-motion: reduce)").matches;
  box.append(replayOf(test, { title: `The worst test, ${test.id}: fails on ${test.runs.filter((run) => run && run.failed).length} of ${plural(test.runs.filter(Boolean).length, "simulator")}, ${test.conditions ? conditionWords(test) : plural(test.road.turns, "turn")}`, playing }));
}

function drawFigure(place) {
  const figure = data.figures[place.dataset.figure];
  const layout = { ...figure.layout };
  // Two titles do not fit side by side on a phone.
  if (narrow.matches && layout.xaxis2) layout.xaxis2 = { ...layout.xaxis2, title: { ...layout.xaxis2.title, text: "AUC-PRC" } };
  newPlot(place, figure.data, layout);
}

async function start() {
  sliceChooser();
  const next = document.querySelector("#finding .command");
  if (next) next.replaceWith(command(next.textContent.trim(), "what to do next"));
  const worst = document.getElementById("worst");
  if (worst) await showWorst(worst);
  for (const group of document.querySelectorAll("[data-maps]")) {
    const names = data.groups[group.dataset.maps];
    group.style.setProperty("--maps", Math.min(names.length, 4));
    group.append(...names.map(mapFigure));
    // Maps in a closed fold have no width and are drawn when it opens.
    group.closest("details")?.addEventListener("toggle", drawAll);
  }
  for (const button of document.querySelectorAll("[data-value]")) button.addEventListener("click", () => showValue(button.dataset.value));
  const numbers = document.getElementById("numbers");
  numbers.addEventListener("toggle", () => numbersTable(numbers.querySelector(".scroll")), { once: true });
  document.getElementById("maps").addEventListener("keydown", onKey);
  window.addEventListener("resize", later(drawAll, 200));
  narrow.addEventListener("change", drawAll);
  window.addEventListener("hashchange", openFromAddress);
  for (const place of document.querySelectorAll("[data-figure]")) {
    const fold = place.closest("details:not([open])"); // a chart in a closed fold has no width, and is drawn when it opens
    if (fold) fold.addEventListener("toggle", () => drawFigure(place), { once: true });
    else drawFigure(place);
  }
  await showValue("probability");
  if (!openFromAddress() && data.selected) await choose(data.selected.join("-"), { remember: false });
  document.body.dataset.ready = "true"; // everything is drawn: for tests, and for printing
}
start().catch((error) => {
  panel.prepend(html("p", { class: "warning" }, `This browser cannot draw the report (${error.message}): try a newer one. The same maps are pictures in the folder maps next to this file.`));
  throw error;
});
})();
