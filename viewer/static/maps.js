// Maps in the colours of print: one map with its colour bar, and a Mueller image as sixteen maps on one scale.

import { ImageView, place, readPlane } from "./images.js";
import { embedded } from "./plots.js";

const colours = embedded("colours");
const ends = (plane, k) => {
  let low = false, high = false;
  for (const row of plane.planes[k]) for (const v of row) { if (v < plane.low) low = true; else if (v > plane.high) high = true; }
  return { low, high };
};
const bar = (plane, more = {}) => ({ thickness: 12, outlinewidth: 0, title: { text: plane.units || "", side: "right" }, ...more });
/** Arrows at the ends of a colour bar beyond which there are values. */
const arrows = (clipped, x) => [["high", "▲", 1, "bottom"], ["low", "▼", 0, "top"]].filter(([end]) => clipped[end]).map(([, text, y, yanchor]) => ({
  text, showarrow: false, xref: "paper", yref: "paper", x, y, xanchor: "left", yanchor, hovertext: "there are values beyond the scale", font: { size: 11 },
}));
/** Those of a map: of its first plane, and its limits. */
export const arrowsOf = plane => arrows(ends(plane, 0), 1.01);
/** Where nothing is known a map is grey, on paper as on a screen. */
const UNKNOWN = { plot_bgcolor: "#d9d9d9" };

/** One map: its first plane with the colours and limits that came with it. */
export const mapTraces = plane => [{
  type: "heatmap", z: plane.planes[0], ...place(plane), zmin: plane.low, zmax: plane.high, colorscale: colours[plane.colours],
  hovertemplate: `column %{x}, row %{y}<br>%{z:.5g} ${plane.units}<extra></extra>`, colorbar: bar(plane, { x: 1.01, len: 0.9 }),
}];

/** A map that pans and zooms; `query` names it at the time of reading. */
export function mapView(node, what, query, shape, chosen) {
  const view = new ImageView(node, {
    shape, chosen, read: (window, signal) => readPlane(what, { ...query(), ...window }, signal), traces: mapTraces,
    more: () => ({ ...UNKNOWN, annotations: view.plane ? arrowsOf(view.plane) : [], margin: { l: 44, r: 8, t: 16, b: 36 } }),
  });
  return view;
}

const GAP = 0.012;
const side = k => [k * 0.25 + GAP / 2, (k + 1) * 0.25 - GAP / 2];
const name = k => (k ? k + 1 : "");

/** Sixteen maps that move together, one colour bar; the first one is m00 in grey. */
export function matrixView(node, what, query, shape, chosen) {
  const view = new ImageView(node, {
    shape, chosen, read: (window, signal) => readPlane(what, { ...query(), ...window, most: Math.min(320, window.most) }, signal),
    traces: plane => plane.planes.map((z, k) => ({
      type: "heatmap", z, ...place(plane), xaxis: `x${name(k)}`, yaxis: `y${name(k)}`, showscale: k === 1,
      zmin: k ? plane.low : 0, zmax: k ? plane.high : plane.light, colorscale: colours[k ? plane.colours : plane.light_colours],
      hovertemplate: `m${k >> 2}${k % 4} at column %{x}, row %{y}: %{z:.5g}<extra></extra>`, colorbar: bar(plane, { len: 0.96, x: 1.005 }),
    })),
    more: () => {
      const axes = {};
      for (let k = 0; k < 16; k++) {
        const bare = { showticklabels: false, ticks: "", showgrid: false, zeroline: false, title: { text: "" } };
        axes[`xaxis${name(k)}`] = { ...bare, domain: side(k % 4), anchor: `y${name(k)}`, constrain: "domain", ...(k ? { matches: "x" } : {}) };
        axes[`yaxis${name(k)}`] = { ...bare, domain: side(3 - (k >> 2)), anchor: `x${name(k)}`, constrain: "domain", ...(k ? { matches: "y" } : {}) };
      }
      const annotations = Array.from({ length: 16 }, (_, k) => ({
        text: `m<sub>${k >> 2}${k % 4}</sub>`, showarrow: false, xref: `x${name(k)} domain`, yref: `y${name(k)} domain`, x: 0.02, y: 0.98,
        xanchor: "left", yanchor: "top", font: { size: 11, color: "#000" }, bgcolor: "rgba(255,255,255,.7)", borderpad: 1,
      }));
      const beyond = view.plane ? Array.from({ length: 15 }, (_, k) => ends(view.plane, k + 1)) : [];
      annotations.push(...arrows({ low: beyond.some(e => e.low), high: beyond.some(e => e.high) }, 1.005));
      return { ...UNKNOWN, ...axes, annotations, margin: { l: 4, r: 60, t: 14, b: 14 } };
    },
  });
  view.axes = Array.from({ length: 16 }, (_, k) => [`x${name(k)}`, `y${name(k)}`]);
  return view;
}
