// Named regions of an image: marked in it, measured in a table, and compared by histogram and profile.

import { accent, at, bad, byId, copies, draw, ink, measured, newestJson, post, quiet, say, warn } from "./plots.js";

const HEADS = ["region", "columns", "rows", "mean", "spread", "pixels"];
const COLOURS = [accent, warn, ink, bad, quiet];
const cell = (text, tag = "td") => { const node = document.createElement(tag); node.textContent = text; return node; };
const range = (first, after) => (after - first === 1 ? `${first}` : `${first} to ${after - 1}`);

export class Regions {
  /** view(): the picture as it is now; query(): what is measured of `file`. */
  constructor(file, view, query) {
    Object.assign(this, { file, view, query, named: [], rows: [], read: newestJson() });
    const form = byId("keep");
    form.addEventListener("submit", event => {
      event.preventDefault();
      const region = this.view().region;
      this.run(async () => {
        if (!region) throw new Error("Choose a pixel, or press Region and draw a rectangle, first.");
        const place = Object.fromEntries(Object.entries(region).map(([name, value]) => [name, String(value)]));
        await post("keep-region", { file, name: form.elements.name.value, ...place });
        form.reset();
        await this.show();
      });
    });
    form.querySelector("button").disabled = false;
    byId("regions-csv").href = at("regions.csv", { file });
    copies(byId("regions-copy"), () => [this.heads(), ...this.rows.map(row => this.texts(row))], byId("regions-told"), byId("regions-problem"));
    byId("along").addEventListener("change", () => this.plots());
  }

  run(action) {
    const place = byId("regions-problem");
    return action().then(() => place.replaceChildren(), error => say(place, error));
  }

  /** Measure the chosen region and the named ones. */
  show() {
    return this.run(async () => {
      const region = this.view()?.region;
      const found = await this.read("regions", { file: this.file, ...this.query(), ...region });
      if (!found) return;
      this.rows = found.regions;
      this.named = this.rows.filter(row => row.name);
      Object.assign(this.view(), { named: this.named });
      this.view().mark();
      this.table();
      this.plots();
    });
  }

  texts(row) {
    const spread = row.spread === null ? "-" : String(Number(row.spread.toPrecision(3)));
    const errors = [row.error, row.systematic].filter(e => e !== null && e !== undefined);
    const mean = measured(row.value, errors) + (row.systematic === null ? "" : " (instrument)");
    return [row.name || "chosen", range(row.x0, row.x1), range(row.y0, row.y1), mean, spread, row.pixels];
  }

  heads() {
    const unit = this.rows[0]?.unit;
    return HEADS.map(text => (unit && /mean|spread/.test(text) ? `${text} / ${unit}` : text));
  }

  table() {
    const head = document.createElement("tr"), lines = this.rows.map(row => {
      const line = document.createElement("tr"), last = document.createElement("td");
      line.append(...this.texts(row).map(text => cell(text)));
      if (row.name) {
        const button = cell("Remove", "button");
        button.setAttribute("aria-label", `Remove ${row.name}`);
        button.addEventListener("click", () => this.run(() => post("drop-region", { name: row.name }).then(() => this.show())));
        last.append(button);
      }
      line.append(last);
      return line;
    });
    head.append(...this.heads().map(text => cell(text, "th")), cell(""));
    byId("region-table").replaceChildren(head, ...lines);
    byId("regions-measured").hidden = !this.rows.length;
    byId("regions-told").textContent = "";
  }

  plots() {
    if (!this.rows.length) return;
    const unit = this.rows[0].unit, along = byId("along").value;
    const each = (drawn, least = 1) => () => this.rows.flatMap((row, k) => (row.pixels < least ? [] : [{ name: row.name || "chosen", ...drawn(row, COLOURS[k % COLOURS.length]()) }]));
    draw(byId("region-histogram"), each((row, colour) => {
      const { edges, pixels } = row.histogram;
      const middle = pixels.map((_, k) => (edges[k] + edges[k + 1]) / 2);
      return { type: "bar", x: middle, y: pixels.map(n => n / row.pixels), width: edges[1] - edges[0], opacity: 0.6, marker: { color: colour, line: { width: 0 } } };
    // One pixel has no histogram: its bar would be as wide as the plot.
    }, 2), () => ({ barmode: "overlay", bargap: 0, showlegend: this.rows.length > 1, xaxis: { title: { text: unit || "value" } }, yaxis: { title: { text: "share of the pixels" } } }));
    draw(byId("region-profile"), each((row, colour) => ({
      mode: "lines", x: row[along].map((_, k) => k + (along === "columns" ? row.x0 : row.y0)), y: row[along], line: { color: colour, width: 1.5 },
    })), () => ({ showlegend: this.rows.length > 1, xaxis: { title: { text: along === "columns" ? "column / pixels" : "row / pixels" } }, yaxis: { title: { text: unit ? `mean / ${unit}` : "mean" } } }));
  }
}
