// The page of a capture: frames with a slider, histogram, and the intensities of a pixel.

import "./start.js";
import { drawsRegions, ImageView, place, readPlane, saturated } from "./images.js";
import { accent, at, bad, byId, draw, embedded, getJson, ink, narrow, newestJson, pressed, say } from "./plots.js";
import { drawCurve, showProbe } from "./probe.js";
import { Regions } from "./regions.js";

const file = byId("look").dataset.file;
const slider = byId("state"), channel = byId("channel"), problem = byId("problem");
let states = embedded("states"), timer = null;

channel.hidden = states.channels.length < 2;
channel.replaceChildren(...states.channels.map((name, k) => new Option(name, k)));

const brightest = plane => plane.planes[0].reduce((most, row) => row.reduce((a, b) => Math.max(a, b), most), states.black + 1);
const view = new ImageView(byId("frame"), {
  shape: states.shape,
  read: (window, signal) => readPlane("frame", { file, state: slider.value, channel: channel.value || 0, ...window }, signal),
  traces: plane => [
    { type: "heatmap", z: plane.planes[0], ...place(plane), zmin: states.black,
      zmax: byId("stretch").checked ? brightest(plane) : states.saturation ?? undefined, hovertemplate: "column %{x}, row %{y}<br>%{z:.1f} counts<extra></extra>",
      colorscale: [[0, "#000"], [1, "#fff"]], colorbar: { title: { text: "counts", side: "right" }, thickness: 12, outlinewidth: 0, len: 0.9 } },
    ...saturated(plane),
  ],
  chosen: region => probe(region),
});

const regions = new Regions(file, () => view, () => ({ state: slider.value, channel: channel.value || 0 }));
const curveOf = newestJson(), matrixOf = newestJson();
const run = action => action().then(() => problem.replaceChildren(), error => say(problem, error));

async function probe(region) {
  regions.show();
  await run(async () => {
    const found = await curveOf("curve", { file, ...region, channel: channel.value || 0 });
    if (!found) return;
    byId("pixel").textContent = found.where;
    byId("fit").textContent = found.told;
    drawCurve(byId("curve"), found, Number(slider.value));
    history.replaceState(null, "", `#x=${region.x0}&y=${region.y0}`);
    // What is known of another pixel goes until this one's is there.
    byId("probe").hidden = true;
    const matrix = found.fit && (found.fit.stokes ? {} : await matrixOf("matrix", { file, ...region }));
    if (!matrix) return;
    byId("probe").hidden = false;
    showProbe(byId("probe"), { ...found, ...matrix });
  });
}

async function drawHistogram() {
  const h = await getJson("histogram", { file, state: slider.value, channel: channel.value || 0 });
  const middle = h.pixels.map((_, k) => (h.edges[k] + h.edges[k + 1]) / 2);
  const wide = h.edges[1] - h.edges[0];
  const lines = [[h.black, ink(), "black"], ...(h.saturation ? [[h.saturation, bad(), "saturated"]] : [])];
  draw(byId("histogram"), () => [{
    type: "bar", x: middle, y: h.pixels, width: wide, marker: { line: { width: 0 }, color: middle.map(v => h.saturation && v >= h.saturation - wide / 2 ? "#e3122d" : accent()) },
    hovertemplate: `%{x:.0f} counts: %{y} pixels<extra></extra>`,
  }], () => ({
    bargap: 0, xaxis: { title: { text: "counts" }, range: [Math.min(h.black, h.edges[0]) - 2, Math.max(h.edges.at(-1), h.saturation ?? 0) * 1.02] },
    yaxis: { title: { text: "pixels" }, type: "log", exponentformat: "power", dtick: 1 },
    shapes: lines.map(([x, color]) => ({ type: "line", x0: x, x1: x, yref: "paper", y0: 0, y1: 1, line: { color, width: 1, dash: "dot" } })),
    annotations: lines.map(([x, color, text]) => ({ x, y: 1, yref: "paper", text, showarrow: false, font: { color }, xanchor: x > h.edges.at(-1) / 2 ? "right" : "left", yanchor: "top" })),
    margin: { t: 6 },
  }));
  byId("saturation").textContent = h.saturation === null ? "Where this detector saturates is not known."
    : `${h.saturated} of ${h.of} pixels saturated (${(100 * h.saturated / h.of).toPrecision(2)} %).`;
}

function told(k) {
  const position = (name, value) => states.voltages.includes(name) ? `${value.toFixed(3)} V` : `${(((value % 360) + 360) % 360).toFixed(2)}°`;
  const angles = Object.entries(states.angles_deg).map(([name, values]) => `${name} ${values[k] === null ? "?" : position(name, values[k])}`);
  const more = narrow() ? [] : [...angles, `${states.exposure_s[k] ?? "?"} s`];
  byId("which").textContent = [`state ${states.number[k]}`, states.role[k], ...more].join(", ");
}

async function show() {
  const k = Number(slider.value);
  if (!states.number.length) { byId("which").textContent = "no state is done yet"; return; }
  told(k);
  slider.setAttribute("aria-valuetext", byId("which").textContent);
  await run(() => view.refresh());
  histogramSoon();
}

// The picture comes first; while the slider is drawn along, only the last histogram is worth drawing.
function histogramSoon() {
  clearTimeout(histogramSoon.pause);
  histogramSoon.pause = setTimeout(() => run(() => Promise.all([drawHistogram(), regions.show()])), 60);
}

function play(on) {
  clearTimeout(timer);
  timer = null;
  byId("play").setAttribute("aria-pressed", on);
  byId("play").textContent = on ? "Pause" : "Play";
  const next = async () => {
    slider.value = (Number(slider.value) + 1) % states.number.length;
    told(Number(slider.value));
    await run(() => view.refresh());
    if (timer !== null) timer = setTimeout(next, 80);
  };
  if (on) timer = setTimeout(next, 0); else show();
}

const step = by => { slider.value = Number(slider.value) + by; show(); };
slider.max = Math.max(states.number.length - 1, 0);
slider.value = Math.max(states.role.findIndex(role => role !== "dark"), 0);
slider.addEventListener("input", show);
channel.addEventListener("change", show);
pressed(byId("play"), () => play(timer === null));
byId("stretch").addEventListener("change", () => run(() => view.show()));
drawsRegions(byId("region"), view.node);
document.addEventListener("keydown", event => {
  if (/^(input|select|textarea)$/i.test(event.target.tagName) && event.target.type !== "range") return;
  if (event.key === ",") step(-1);
  else if (event.key === ".") step(1);
  else if (event.key === " " && !/^(button|summary|a)$/i.test(event.target.tagName)) { play(timer === null); event.preventDefault(); }
  else if (document.activeElement === view.node) view.key(event);
});

async function follow() {
  let now;
  try {
    now = await getJson("states", { file });
  } catch (error) {
    // When it is complete it loses its partial name.
    if (!file.endsWith(".partial")) throw error;
    location.replace(at("capture", { file: file.slice(0, -".partial".length) }));
    return;
  }
  const atEnd = Number(slider.value) === states.number.length - 1 || !states.number.length;
  states = now;
  slider.max = Math.max(states.number.length - 1, 0);
  if (atEnd) { slider.value = slider.max; await show(); }
  byId("status").textContent = `${now.status}, ${now.number.length} of ${now.planned}`;
  if (now.status === "running") setTimeout(follow, 1000);
}

async function begin() {
  await show();
  const wanted = new URLSearchParams(location.hash.slice(1));
  const x = Number(wanted.get("x")), y = Number(wanted.get("y"));
  if (wanted.has("x")) view.choose({ x0: x, y0: y });
  if (byId("look").dataset.writing) run(follow);
  document.body.dataset.ready = "yes";
}

begin();
