// The page of a product: its maps, and what it says of a pixel.

import "./start.js";
import { drawsRegions } from "./images.js";
import { mapView, matrixView } from "./maps.js";
import { byId, embedded, measured, newestJson, say } from "./plots.js";
import { drawCurve, showProbe } from "./probe.js";
import { Regions } from "./regions.js";

const file = byId("look").dataset.file, spec = embedded("spec"), problem = byId("problem");
const map = byId("map"), errors = byId("errors"), normalized = byId("normalized");
if (spec.matrices) map.append(new Option("Mueller matrix", "mueller"));
spec.maps.forEach((m, k) => map.append(new Option(m.label, k)));
const chosenMap = () => (map.value === "mueller" ? null : spec.maps[Number(map.value)]);
const probeOf = newestJson();
const run = action => action().then(() => problem.replaceChildren(), error => say(problem, error));
const flag = box => (box.checked ? "1" : null);
const node = byId("plot");
let view = null, region = null;
const regions = new Regions(file, () => view, () => { const { name, index } = spec.choices[Number(byId("of").value)]; return { name, index }; });

function newView() {
  Plotly.purge(node);
  if (chosenMap()) {
    node.style.height = "34rem";
    return mapView(node, "plane", () => ({ file, name: chosenMap().name, index: chosenMap().index, errors: flag(errors) }), spec.shape, probe);
  }
  const wide = Math.min(node.clientWidth - 64, 1000);
  node.style.height = `${Math.max(260, Math.min(wide * spec.shape[0] / spec.shape[1], 900))}px`;
  return matrixView(node, "mueller", () => ({ file, normalized: flag(normalized), errors: flag(errors) }), spec.shape, probe);
}

async function show(fresh) {
  const m = chosenMap();
  normalized.parentElement.hidden = Boolean(m);
  errors.disabled = Boolean(m) && !m.errors;
  if (errors.disabled) errors.checked = false;
  byId("about").textContent = m ? m.about : normalized.checked
    ? "Elements over m00 on one scale, instrument frames; the first panel is m00 in counts. Grey: too dark, or not determined." : "Elements in counts on one scale, instrument frames.";
  if (fresh) { view = newView(); view.region = region; view.named = regions.named; }
  await run(() => view.refresh());
}

// Without an error bar, where others of its kind have one, a value may be noise: it must not look certain.
// Noise averages over a region; what the instrument's uncertainty does is the same in all of it.
const withError = (v, plane, k) => {
  const parts = ["error", "systematic"].filter(part => plane[part]);
  return measured(v, parts.map(part => plane[part][k])) + (parts.includes("systematic") && v !== null ? " (instrument)" : "");
};

async function probe(chosen) {
  region = chosen;
  regions.show();
  await run(async () => {
    const found = await probeOf("probe", { file, ...chosen });
    if (!found) return;
    byId("values").hidden = false;
    byId("pixel").textContent = found.where + (found.mask ? ` (${found.mask})` : "");
    byId("fit").textContent = found.told;
    byId("curve").hidden = !found.counts;
    if (found.counts) drawCurve(byId("curve"), found);
    byId("numbers").replaceChildren(...found.planes.map(plane => {
      const line = document.createElement("tr"), head = document.createElement("th"), cell = document.createElement("td");
      head.textContent = plane.name.replaceAll("_", " ");
      head.title = plane.about;
      cell.textContent = plane.value.map((v, k) => withError(v, plane, k)).join(",  ");
      line.append(head, cell);
      return line;
    }));
    showProbe(byId("probe"), found);
    history.replaceState(null, "", `#x=${chosen.x0}&y=${chosen.y0}`);
  });
}

map.addEventListener("change", () => show(true));
byId("of").addEventListener("change", () => regions.show());
errors.addEventListener("change", () => show(false));
normalized.addEventListener("change", () => show(false));
drawsRegions(byId("region"), node);
node.addEventListener("keydown", event => view.key(event));

addEventListener("load", async () => {
  await show(true);
  regions.show();
  const wanted = new URLSearchParams(location.hash.slice(1));
  if (wanted.has("x")) view.choose({ x0: Number(wanted.get("x")), y0: Number(wanted.get("y")) });
  document.body.dataset.ready = "yes";
});
