// What is known of a pixel: its intensities with the fitted curve, its Mueller matrix, where it lies in the simplex.

import { accent, draw, ink, measured, quiet, warn } from "./plots.js";

const SYMBOLS = ["circle", "square", "diamond", "cross"];

/** Intensities of the states, the fitted curve, and below it residuals in units of the noise. */
export function drawCurve(node, found, now = null) {
  const fit = found.fit;
  const dark = found.role ? found.role.map(role => role === "dark") : [];
  draw(node, () => {
    const traces = [];
    if (fit) {
      // The analyzers of a polarization camera have a curve each; their values take turns.
      (fit.series ?? [""]).forEach((name, k, { length }) => {
        const turn = values => values.filter((_, n) => n % length === k), said = name ? ` ${name}` : "", first = k === 0;
        traces.push({ x: turn(fit.states), y: turn(fit.fitted), mode: "lines", name: "fitted", showlegend: first, line: { color: accent(), width: 1.5, shape: "linear" }, hovertemplate: `fitted${said} %{y:.1f}<extra></extra>` });
        traces.push({ x: turn(fit.states), y: turn(fit.signal), mode: "markers", name: name || "signal", marker: { color: ink(), size: 6, symbol: SYMBOLS[k % SYMBOLS.length] },
          error_y: { type: "data", array: turn(fit.noise), color: ink(), thickness: 1, width: 0 }, hovertemplate: `state %{x}${said}: %{y:.1f} counts<extra></extra>` });
      });
      traces.push({ x: fit.states, y: fit.residual, mode: "markers", marker: { color: ink(), size: 5 }, yaxis: "y2", showlegend: false, hovertemplate: "state %{x}: %{y:.2f} noise<extra></extra>" });
    } else if (found.counts) {
      const pick = wanted => found.state.filter((_, k) => dark[k] === wanted);
      const value = wanted => found.counts.filter((_, k) => dark[k] === wanted);
      traces.push({ x: pick(false), y: value(false), mode: "markers+lines", name: "counts", marker: { color: accent(), size: 5 }, line: { width: 1 }, hovertemplate: "state %{x}: %{y:.1f} counts<extra></extra>" });
      traces.push({ x: pick(true), y: value(true), mode: "markers", name: "dark", marker: { color: quiet(), size: 5, symbol: "square-open" }, hovertemplate: "state %{x}, dark: %{y:.1f} counts<extra></extra>" });
    }
    return traces;
  }, () => {
    const worst = fit ? Math.max(4, ...fit.residual.map(v => Math.abs(v ?? 0) * 1.1)) : 4;
    const shapes = now === null || !found.state ? [] : [{ type: "line", x0: found.state[now], x1: found.state[now], yref: "paper", y0: 0, y1: 1, line: { color: warn(), width: 1, dash: "dot" } }];
    const both = { xaxis: { title: { text: "state" } }, yaxis: { title: { text: fit ? "signal / counts" : "counts" }, rangemode: "tozero", domain: fit ? [0.47, 1] : [0, 1] } };
    if (!fit) return { ...both, shapes, showlegend: true };
    const zone = { type: "rect", xref: "paper", x0: 0, x1: 1, yref: "y2", y0: -2, y1: 2, fillcolor: accent(), opacity: 0.12, line: { width: 0 }, layer: "below" };
    return {
      ...both, showlegend: true, shapes: [...shapes, zone], xaxis: { title: { text: "state" }, anchor: "y2" },
      yaxis2: { domain: [0, 0.38], range: [-worst, worst], title: { text: "residual / noise" }, gridcolor: "rgba(128,128,128,.25)", zerolinecolor: quiet(), automargin: true },
    };
  });
}

const number = (v, digits = 4) => v === null || v === undefined ? "-" : Math.abs(v) >= 1e4 ? v.toExponential(2) : v.toFixed(digits);
// Noise may make anything of a value without an error bar: it must not look certain.
const UNKNOWN = "± ?: too near to the noise, or to a place where its error bar would not hold.";
const cell = (text, tag = "td") => { const node = document.createElement(tag); node.textContent = text; return node; };
const row = (...cells) => { const node = document.createElement("tr"); node.append(...cells); return node; };
const heading = text => cell(text, "h3");
const scroll = inner => { const node = document.createElement("div"); node.className = "scroll"; node.append(inner); return node; };

function muellerTable(matrix) {
  const table = document.createElement("table");
  table.className = "matrix";
  matrix.mueller.forEach((line, i) => {
    const cells = line.map((v, j) => {
      const [shown, error] = v === null ? ["-", "not seen"] : measured(v, [matrix.mueller_errors[i][j]]).split(" ± ");
      const node = cell(i || j ? shown : "1");
      const small = cell(i || j ? (v === null ? error : `± ${error}`) : `m00 = ${measured(matrix.m00, [matrix.m00_error])}`, "small");
      node.append(small);
      return node;
    });
    table.append(row(...cells));
  });
  return table;
}

const NAMES = {
  coherency_eigenvalues: "coherency eigenvalues ξ0 ... ξ3", td_missed: "light that the triply degenerate model misses", entropy: "entropy",
  depolarization_index: "depolarization index", diattenuation: "diattenuation",
  diattenuation_orientation_deg: "its orientation / degrees", polarizance: "polarizance",
  polarizance_orientation_deg: "its orientation / degrees", dominant_diattenuation_linear: "linear diattenuation of the dominant process",
  dominant_diattenuation_orientation_deg: "its orientation / degrees",
  retardance_deg: "retardance (Lu-Chipman) / degrees", retardance_fast_axis_deg: "its fast axis / degrees", depolarization_power: "depolarization power (Lu-Chipman)",
};

function quantityTable(quantities) {
  const table = document.createElement("table");
  table.className = "facts";
  for (const [name, label] of Object.entries(NAMES)) {
    const found = quantities[name];
    if (!found) continue;
    const text = found.value.map((v, k) => measured(v, [found.error[k]])).join(", ");
    table.append(row(cell(label, "th"), cell(text)));
  }
  return table;
}

// Ordered eigenvalues lie in a tetrahedron between one, two, three and four equal processes; seen from its side.
const CORNERS = { "1 process": [0, 0], "2 equal": [0.86, 0.3], "3 equal": [0.62, 0.78], "4 equal": [0.1, 1] };
function corner(xi) {
  const weights = [xi[0] - xi[1], 2 * (xi[1] - xi[2]), 3 * (xi[2] - xi[3]), 4 * xi[3]];
  const places = Object.values(CORNERS);
  return [0, 1].map(k => weights.reduce((sum, w, n) => sum + w * places[n][k], 0));
}

function drawSimplex(node, values) {
  const points = Object.values(CORNERS), names = Object.keys(CORNERS);
  const edges = [[0, 1], [0, 2], [1, 2], [1, 3], [2, 3]];
  const [x, y] = corner(values);
  draw(node, () => [
    ...edges.map(([a, b]) => ({ x: [points[a][0], points[b][0]], y: [points[a][1], points[b][1]], mode: "lines", line: { color: quiet(), width: 1 }, hoverinfo: "skip" })),
    { x: [points[0][0], points[3][0]], y: [points[0][1], points[3][1]], mode: "lines", line: { color: warn(), width: 3 }, hovertext: "triply degenerate: ξ1 = ξ2 = ξ3", hoverinfo: "text" },
    { x: points.map(p => p[0]), y: points.map(p => p[1]), mode: "markers+text", text: names, textposition: ["bottom right", "bottom center", "top right", "top right"], marker: { color: quiet(), size: 6 }, hoverinfo: "skip", cliponaxis: false },
    { x: [x], y: [y], mode: "markers", marker: { color: accent(), size: 13, symbol: "diamond", line: { color: ink(), width: 1 } }, hovertemplate: `ξ = ${values.map(v => v.toFixed(4)).join(", ")}<extra></extra>` },
  ], () => ({
    xaxis: { visible: false, range: [-0.12, 1.2] }, yaxis: { visible: false, range: [-0.12, 1.14] }, margin: { l: 4, r: 4, t: 4, b: 4 },
  }));
}

function showStokes(node, found) {
  const table = document.createElement("table");
  table.className = "facts";
  for (const [name, { value, error }] of Object.entries(found.fit.stokes)) {
    table.append(row(cell(name, "th"), cell(measured(value, [error]))));
  }
  node.replaceChildren(cell(`At ${found.where}`, "h2"), heading("Stokes vector of the super-pixels, with standard errors"), table, cell(chiSquare(found.fit), "p"));
}

const chiSquare = fit => `Chi-square of the fit over its degrees of freedom: ${number(fit.chi_square, 2)}${fit.noise_known ? "" : " (noise taken from the residual)"}`;

function simplexPlot() {
  const plot = document.createElement("div");
  plot.className = "plot";
  plot.setAttribute("role", "figure");
  plot.setAttribute("aria-label", "place of the eigenvalues in the simplex");
  return plot;
}

/** Mueller matrix with error bars, decomposition, and place in the simplex. */
export function showProbe(node, found) {
  const matrix = found.matrix, stokes = found.fit?.stokes;
  node.hidden = !matrix && !stokes;
  if (stokes) showStokes(node, found);
  if (!matrix) return;
  const columns = document.createElement("div"), left = document.createElement("div"), right = document.createElement("div");
  columns.className = "columns";
  left.append(heading("Mueller matrix over m00, with standard errors"), scroll(muellerTable(matrix)));
  const xi = matrix.quantities.coherency_eigenvalues;
  const plot = node.querySelector(".plot") || simplexPlot();
  if (xi && xi.value.every(v => v !== null)) left.append(heading("Where its eigenvalues lie; the thick edge is the triply degenerate model"), plot);
  right.append(heading("Decomposition"));
  if (xi) right.append(scroll(quantityTable(matrix.quantities)), cell(UNKNOWN, "p"));
  else right.append(cell("A part of a Mueller matrix has none.", "p"));
  if (found.fit) right.append(cell(chiSquare(found.fit), "p"));
  columns.append(left, right);
  const title = cell(`At ${found.where}`, "h2");
  node.replaceChildren(title, columns);
  if (plot.isConnected) drawSimplex(plot, xi.value);
}
