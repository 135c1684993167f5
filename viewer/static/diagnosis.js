// The page of a diagnosis: maps before and after that move together, states, harmonics, and the decision.

import "./start.js";
import { ImageView, readPlane } from "./images.js";
import { mapTraces } from "./maps.js";
import { accent, byId, draw, embedded, newestJson, post, pressed, quiet, say } from "./plots.js";

const spec = embedded("spec"), MOMENTS = ["before", "after"];
const colourOf = moment => (moment === "before" ? quiet() : accent());
const curveOf = newestJson();
let state = null, views = [];
const name = byId("decision").dataset.name;
const number = () => Number(byId("capture").value);
const capture = () => spec.captures[number()];

function newViews() {
  views = MOMENTS.map((moment, k) => new ImageView(byId(moment), {
    shape: capture().shape, chosen: region => pixel(region, k),
    traces: plane => mapTraces({ ...plane, planes: [plane.planes[k]], low: state === null ? 0 : -capture().loudest, high: capture().loudest }),
  }));
  views.forEach(view => { view.refresh = () => refresh(view); });
}

async function refresh(leader = views[0]) {
  const plane = await readPlane("residual-map", { name, capture: number(), state, ...leader.window() });
  const ranges = leader.node.layout && [leader.node.layout.xaxis.range, leader.node.layout.yaxis.range];
  byId("which").textContent = state === null ? "rms over the states" : `state ${state}`;
  for (const view of views) {
    view.plane = plane;
    if (ranges && view !== leader) view.more = () => ({ xaxis: { range: [...ranges[0]] }, yaxis: { range: [...ranges[1]] } });
    await view.show();
  }
}

function drawStates() {
  const { per_state, harmonics } = capture();
  const node = byId("states");
  draw(node, () => MOMENTS.map(moment => ({ y: per_state[moment], mode: "lines+markers", name: moment, line: { width: 1, color: colourOf(moment) }, marker: { size: 6 },
    hovertemplate: `state %{x}, ${moment}: %{y:.3f}<extra></extra>` })),
    () => ({ showlegend: true, xaxis: { title: { text: "state (and channel)" } }, yaxis: { title: { text: "residual / noise" }, rangemode: "tozero" } }));
  if (!node.dataset.heard) {
    node.dataset.heard = "yes";
    node.on("plotly_click", event => { state = event.points[0].x; refresh(); });
  }
  const axes = Object.keys(harmonics.before);
  draw(byId("harmonics"), () => MOMENTS.flatMap(moment => axes.map((axis, k) => ({
    type: "bar", x: harmonics[moment][axis].map((_, h) => `${h + 1}`), y: harmonics[moment][axis], name: `${axis} ${moment}`,
    marker: { color: colourOf(moment), pattern: { shape: ["", "/", "x", "."][k % 4] } }, hovertemplate: `${axis}, %{x} a turn, ${moment}: %{y:.3f}<extra></extra>`,
  }))), () => ({ showlegend: true, barmode: "group", xaxis: { title: { text: "periods a turn" }, type: "category" }, yaxis: { title: { text: "amplitude / noise" } } }));
}

async function pixel(region, k) {
  views[1 - k].choose(region, false);
  const found = await curveOf("residual-curve", { name, capture: number(), ...region });
  if (!found) return;
  byId("pixel").textContent = found.where;
  byId("curve").hidden = false;
  draw(byId("curve"), () => MOMENTS.map(moment => ({ y: found[moment], mode: "markers", name: moment, marker: { size: 6, color: colourOf(moment), symbol: moment === "before" ? "circle-open" : "circle" } })),
    () => ({ showlegend: true, xaxis: { title: { text: "state (and channel)" } }, yaxis: { title: { text: "residual / noise" } } }));
}

function decide(fields) {
  return post("decide", { name, note: byId("note").value, ...fields }).then(() => location.reload(), error => say(byId("answer"), error));
}
if (byId("accept")) pressed(byId("accept"), () => decide({ accept: "yes", file: byId("file").value }));
if (byId("reject")) pressed(byId("reject"), () => decide({}));

addEventListener("load", async () => {
  if (spec.captures.length) {
    newViews();
    byId("capture").addEventListener("change", () => { state = null; MOMENTS.forEach(m => Plotly.purge(byId(m))); newViews(); drawStates(); refresh(); });
    pressed(byId("all"), () => { state = null; refresh(); });
    drawStates();
    await refresh();
  }
  document.body.dataset.ready = "yes";
});
