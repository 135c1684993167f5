// A region followed through the products of a folder: a curve for each sample, wavelength and arm angle.

import { accent, at, bad, byId, copies, draw, embedded, ink, measured, newestJson, quiet, say, warn } from "./plots.js";

const spec = embedded("spec"), read = newestJson();
const COLOURS = [accent, warn, ink, bad, quiet], SYMBOLS = ["circle", "square", "diamond", "cross", "triangle-up"];
const TITLES = { omega: "Ω / deg", nm: "wavelength / nm", time: "time of the capture", sample: "sample" };
const NAMES = { sample: value => value, nm: value => `${value} nm`, omega: value => (value === null ? "no Ω" : `Ω ${value}`) };
let points = [];

const total = ({ error, systematic }) => (error === null ? null : Math.hypot(error, systematic ?? 0));
const unit = () => points.find(point => point.unit)?.unit ?? "";
const asked = () => {
  const { name, index, label } = spec.choices[Number(byId("of").value)];
  return { kind: spec.kind, q: spec.q, name, index, label, region: byId("where").value };
};

/** Curves: points that differ in what the curve runs over alone, in its order. */
function curves() {
  const over = byId("over").value, rest = Object.keys(NAMES).filter(name => name !== over);
  const varied = rest.filter(name => new Set(points.map(point => point[name])).size > 1);
  const groups = new Map();
  for (const point of points.filter(shown)) {
    const key = varied.map(name => NAMES[name](point[name])).join(", ");
    groups.set(key, [...(groups.get(key) ?? []), point]);
  }
  const ordered = (a, b) => (a[over] < b[over] ? -1 : a[over] > b[over] ? 1 : 0);
  return [...groups].map(([name, group], k) => {
    const sorted = [...group].sort(ordered), errors = sorted.map(total);
    const colour = COLOURS[k % COLOURS.length]();
    return {
      name, mode: over === "sample" ? "markers" : "lines+markers", x: sorted.map(point => point[over]), y: sorted.map(point => point.value),
      error_y: { type: "data", array: errors.map(e => e ?? 0), visible: errors.some(e => e > 0), color: colour, thickness: 1.2 },
      marker: { color: colour, symbol: SYMBOLS[Math.floor(k / COLOURS.length) % SYMBOLS.length], size: 7 }, line: { color: colour, width: 1.5 },
      text: sorted.map(point => point.file), hovertemplate: "%{text}<br>%{x}: %{y:.5g} ± %{error_y.array:.2g}<extra></extra>",
    };
  });
}
const shown = point => point.value !== null && (byId("over").value === "sample" || (point[byId("over").value] ?? "") !== "");

function plot() {
  const over = byId("over").value, missing = points.filter(point => !shown(point)).length;
  const words = missing ? `; ${missing} without ${points.some(p => p.value === null) ? "a value" : TITLES[over]}` : "";
  byId("told").textContent = `${points.length} images${words}${left}`;
  const label = spec.choices[Number(byId("of").value)].label;
  draw(byId("stack-curve"), curves, () => ({
    showlegend: curves().length > 1, xaxis: { title: { text: TITLES[over] }, type: { time: "date", sample: "category" }[over] ?? "linear" },
    yaxis: { title: { text: unit() ? `${label} / ${unit()}` : label } },
  }));
}

const texts = point => [
  point.file, measured(point.value, [point.error, point.systematic].filter(e => e !== null)),
  point.spread === null ? "-" : Number(point.spread.toPrecision(3)), point.pixels,
  point.sample, point.nm ?? "", point.omega ?? "", point.time.slice(0, 19).replace("T", " "),
].map(String);
const heads = () => ["image", unit() ? `mean / ${unit()}` : "mean", "spread", "pixels", "sample", "nm", "Ω / deg", "time"];

function table() {
  const line = (cells, tag) => {
    const row = document.createElement("tr");
    row.append(...cells.map(text => { const cell = document.createElement(tag); cell.textContent = text; return cell; }));
    return row;
  };
  const rows = points.map(point => {
    const row = line(texts(point), "td"), link = document.createElement("a");
    link.href = at("product", { file: point.file });
    link.textContent = point.file;
    row.firstChild.replaceChildren(link);
    return row;
  });
  byId("stack-table").replaceChildren(line(heads(), "th"), ...rows);
}

let left = "";
async function refresh() {
  byId("told").textContent = "reading ...";
  byId("stack-csv").href = at("stack.csv", asked());
  try {
    const found = await read("stacked", asked());
    if (!found) return;
    points = found.points;
    left = Object.entries(found.left_out).map(([why, count]) => `; ${count} left out: ${why}`).join("");
    byId("stack-problem").replaceChildren();
    plot();
    table();
  } catch (error) {
    byId("told").textContent = "";
    say(byId("stack-problem"), error);
  }
}

if (byId("of")) {
  for (const name of ["of", "where"]) byId(name).addEventListener("change", refresh);
  byId("over").addEventListener("change", plot);
  copies(byId("stack-copy"), () => [heads(), ...points.map(texts)], byId("told"), byId("stack-problem"));
  addEventListener("load", async () => { await refresh(); document.body.dataset.ready = "yes"; });
}
