// Pictures of numbers: read from the server in the resolution that the screen shows, and again for what is zoomed into.

import { at, draw, pressed } from "./plots.js";

/** Read a picture; its planes as arrays of rows, with where its pixels lie in the image. */
export async function readPlane(what, query, signal) {
  const answer = await fetch(at(what, query), { signal });
  if (!answer.ok) throw new Error(await answer.text());
  const told = JSON.parse(answer.headers.get("X-Plane"));
  const values = new Float32Array(await answer.arrayBuffer());
  const size = told.rows * told.columns;
  const planes = [];
  for (let k = 0; k < values.length / size; k++) {
    const rows = [];
    for (let r = 0; r < told.rows; r++) rows.push(values.subarray(k * size + r * told.columns, k * size + (r + 1) * told.columns));
    planes.push(rows);
  }
  return { ...told, planes };
}

/** Saturated pixels in red, where there are any: the second plane of a frame. */
export const saturated = plane => !plane.planes[1].some(row => row.some(v => v > 0)) ? [] : [{
  type: "heatmap", z: plane.planes[1].map(row => Array.from(row, v => v ? 1 : null)), ...place(plane), hoverinfo: "skip",
  showscale: false, zmin: 0, zmax: 1, colorscale: [[0, "#e3122d"], [1, "#e3122d"]],
}];

/** Where a picture's pixels lie, as a heat map wants it: centres, in pixels of the image. */
export const place = plane => ({
  x0: plane.x0 + (plane.step - 1) / 2, dx: plane.step, y0: plane.y0 + (plane.step - 1) / 2, dy: plane.step,
});

/** Longest side over the shortest, up to which pixels are drawn square. */
const MOST_ASPECT = 16;

/** A button that switches between zooming and drawing a region; it looks pressed once the picture does so. */
export function drawsRegions(button, node) {
  pressed(button, async () => {
    const on = button.getAttribute("aria-pressed") !== "true";
    await Plotly.relayout(node, { dragmode: on ? "select" : "zoom" });
    button.setAttribute("aria-pressed", on);
  });
}

/**
 * An image with pan, zoom and a chosen pixel or region; what is zoomed into is read again in full resolution.
 *
 * read(query, signal): reads the window that `query` names; traces(plane): heat maps of it; more(): further layout.
 * chosen({x0, x1, y0, y1}): told of a click on a pixel, or of a region drawn with the select tool.
 */
export class ImageView {
  constructor(node, { read, traces, shape, more = () => ({}), chosen }) {
    Object.assign(this, { node, read, traces, shape, more, chosen, plane: null, region: null, named: [], axes: [["x", "y"]] });
    node.dataset.wheel = "yes";
  }

  window() {
    const [x0, x1] = this.node.layout?.xaxis?.range || [-0.5, this.shape[1] - 0.5];
    const [a, b] = this.node.layout?.yaxis?.range || [this.shape[0] - 0.5, -0.5];
    const inside = (v, top) => Math.min(Math.max(v, 0), top);
    return {
      x0: inside(Math.floor(x0 + 0.5), this.shape[1] - 1), x1: inside(Math.ceil(x1 + 0.5), this.shape[1]),
      y0: inside(Math.floor(Math.min(a, b) + 0.5), this.shape[0] - 1), y1: inside(Math.ceil(Math.max(a, b) + 0.5), this.shape[0]),
      most: Math.min(1024, Math.ceil(this.node.clientWidth * Math.min(devicePixelRatio, 2)) || 600),
    };
  }

  /** Read what is seen now and show it; a later call ends an earlier one. */
  async refresh() {
    this.reading?.abort();
    this.reading = new AbortController();
    try {
      const plane = await this.read(this.window(), this.reading.signal);
      this.plane = plane;
      await this.show();
    } catch (error) {
      if (error.name !== "AbortError") throw error;
    }
  }

  async show() {
    if (!this.plane) return;
    const first = !this.node.layout;
    await draw(this.node, () => this.traces(this.plane), () => this.frame());
    if (first) {
      this.node.querySelector(".preview")?.remove();
      this.listen();
    }
  }

  frame() {
    const more = this.more();
    return {
      dragmode: this.node.layout?.dragmode || "zoom", margin: { l: 44, r: 8, t: 8, b: 36 },
      ...more,
      xaxis: { range: [-0.5, this.shape[1] - 0.5], constrain: "domain", title: { text: "column / pixels" }, showgrid: false, zeroline: false, ...more.xaxis },
      yaxis: { range: [this.shape[0] - 0.5, -0.5], ...this.anchor("x"), constrain: "domain", title: { text: "row / pixels" }, showgrid: false, zeroline: false, ...more.yaxis },
      shapes: [...this.marks(), ...(more.shapes || [])],
    };
  }

  /** Square pixels, but for an image of a few long rows or columns (a line camera, a spectrum), of which a line were left. */
  anchor(axis) {
    const [rows, columns] = this.shape;
    return Math.max(rows, columns) > MOST_ASPECT * Math.min(rows, columns) ? {} : { scaleanchor: axis };
  }

  marks() {
    const box = ({ x0, x1, y0, y1 }) => ({ type: "rect", x0: x0 - 0.5, x1: x1 - 0.5, y0: y0 - 0.5, y1: y1 - 0.5 });
    const marks = this.named.map(one => ({
      ...box(one), line: { color: "#ff2d95", width: 1, dash: "dot" }, label: { text: one.name, textposition: "top left", font: { color: "#ff2d95", size: 11 } },
    }));
    if (this.region) marks.push({ ...box(this.region), line: { color: "#ff2d95", width: 2 } });
    return this.axes.flatMap(([xref, yref]) => marks.map(mark => ({ ...mark, xref, yref })));
  }

  /** Draw the marks again. */
  mark() {
    if (this.node.layout) Plotly.relayout(this.node, { shapes: this.frame().shapes });
  }

  listen() {
    let pause;
    this.node.on("plotly_relayout", change => {
      if (!Object.keys(change).some(key => /axis/.test(key))) return;
      clearTimeout(pause);
      pause = setTimeout(() => this.refresh(), 120);
    });
    this.node.on("plotly_click", event => {
      const point = event.points[0];
      this.choose({ x0: Math.round(point.x), y0: Math.round(point.y) });
    });
    this.node.on("plotly_selected", event => {
      if (!event?.range) return;
      const [x0, x1] = event.range.x.map(Number).sort((a, b) => a - b);
      const [y0, y1] = event.range.y.map(Number).sort((a, b) => a - b);
      this.choose({ x0: Math.ceil(x0), x1: Math.floor(x1) + 1, y0: Math.ceil(y0), y1: Math.floor(y1) + 1 });
    });
  }

  /** Mark a pixel or a region and tell of it. */
  choose({ x0, y0, x1 = x0 + 1, y1 = y0 + 1 }, told = true) {
    const inside = (v, low, high) => Math.min(Math.max(v, low), high);
    x0 = inside(x0, 0, this.shape[1] - 1); x1 = inside(x1, x0 + 1, this.shape[1]);
    y0 = inside(y0, 0, this.shape[0] - 1); y1 = inside(y1, y0 + 1, this.shape[0]);
    this.region = { x0, x1, y0, y1 };
    this.mark();
    if (told) this.chosen?.(this.region);
  }

  /** Arrow keys move the chosen pixel; with Shift by ten. */
  key(event) {
    const step = event.shiftKey ? 10 : 1;
    const moves = { ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, -step], ArrowDown: [0, step] };
    if (!(event.key in moves)) return false;
    const [dx, dy] = moves[event.key];
    const { x0, y0 } = this.region || { x0: this.shape[1] >> 1, y0: this.shape[0] >> 1 };
    this.choose({ x0: x0 + dx, y0: y0 + dy });
    event.preventDefault();
    return true;
  }
}
