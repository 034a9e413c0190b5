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

async function start() {
  sliceChooser();
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
    const figure = data.figures[place.dataset.figure];
    const layout = { ...figure.layout };
    // Two titles do not fit side by side on a phone.
    if (narrow.matches && layout.xaxis2) layout.xaxis2 = { ...layout.xaxis2, title: { ...layout.xaxis2.title, text: "AUC-PRC" } };
    newPlot(place, figure.data, layout);
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
