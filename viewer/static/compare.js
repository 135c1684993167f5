// Two files side by side: four linked maps, read together.

import { ImageView, readPlane } from "./images.js";
import { arrowsOf, mapTraces } from "./maps.js";
import { byId, embedded, say } from "./plots.js";

const { a, b } = byId("look").dataset, spec = embedded("spec"), choice = byId("choice"), how = byId("how");
choice.replaceChildren(...spec.choices.map((c, k) => new Option(c.label, k)));
const nodes = [0, 1, 2, 3].map(k => byId(`p${k}`));

const mapOf = (plane, k) => ({ ...plane, ...plane.scales[k], units: k === 3 ? "standard errors" : k === 2 && how?.value ? "" : plane.units, planes: [plane.planes[k]] });
const views = nodes.map((node, k) => new ImageView(node, { shape: spec.shape, traces: plane => mapTraces(mapOf(plane, k)) }));
/** Arrows where a scale is left, and the part of the image that all four show. */
const seen = (view, k, ranges) => () => ({
  annotations: view.plane ? arrowsOf(mapOf(view.plane, k)) : [], margin: { l: 44, r: 8, t: 16, b: 36 },
  ...(ranges && { xaxis: { range: [...ranges[0]] }, yaxis: { range: [...ranges[1]] } }),
});
// One read fills all four; whichever is zoomed takes the others along.
const read = async (window, signal) => {
  const { state, name, index } = spec.choices[Number(choice.value)];
  return readPlane("difference", { a, b, state, name, index, ratio: how?.value ?? "", ...window, most: Math.min(window.most, 640) }, signal);
};
let reading;
async function refresh(leader = views[0]) {
  reading?.abort();
  reading = new AbortController();
  try {
    const plane = await read(leader.window(), reading.signal);
    const told = v => (v === null ? "not known" : v.toPrecision(3));
    const unit = how?.value ? "" : plane.units && ` ${plane.units}`, what = how?.value ? "A / B \u2212 1" : "A \u2212 B";
    byId("h2").textContent = what;
    byId("h3").textContent = `(${what}) over its standard error`;
    byId("told").textContent = `rms of ${what}: ${told(plane.rms)}${unit}; its standard error by noise ${told(plane.rms_noise)}, by the instrument ${told(plane.rms_systematic)}; over its error ${told(plane.rms_over)} (1: errors alone)${how?.value ? "; empty where B is less than five of its standard errors" : ""}`;
    const ranges = leader.node.layout && [leader.node.layout.xaxis.range, leader.node.layout.yaxis.range];
    for (const [k, view] of views.entries()) {
      view.plane = plane;
      view.more = seen(view, k, view !== leader && ranges);
      await view.show();
    }
    byId("problem").replaceChildren();
  } catch (error) {
    if (error.name !== "AbortError") say(byId("problem"), error);
  }
}
views.forEach(view => { view.refresh = () => refresh(view); });
for (const menu of [choice, how]) menu?.addEventListener("change", () => refresh());
addEventListener("load", async () => { await refresh(); document.body.dataset.ready = "yes"; });
