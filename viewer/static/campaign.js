// The page of a campaign: its timeline, and what a run does while it runs.

import "./start.js";
import { ImageView, place, readPlane, saturated } from "./images.js";
import { accent, at, byId, draw, duration, embedded, getJson, narrow, post, quiet, say, statusColour } from "./plots.js";

const run = byId("run"), folder = run.dataset.folder;
let view = null, shown = {}, logged = null;

/** A time of a file, which names its zone, as the clock on the wall has it. */
const local = text => { const d = new Date(text); return isNaN(d) ? text : new Date(d - d.getTimezoneOffset() * 60000).toISOString().slice(0, 23); };

function timeline() {
  if (!byId("bars")) return;
  const bars = embedded("bars"), names = [...new Set(bars.map(bar => bar.name))];
  const now = new Date().toISOString();
  draw(byId("timeline"), () => bars.map(bar => ({
    type: "scatter", mode: "lines", x: [local(bar.start), local(bar.end ?? now)], y: [bar.name, bar.name], line: { color: statusColour(bar.status), width: 11 },
    hovertemplate: `${bar.name}<br>%{x|%H:%M:%S}: ${bar.status}<extra></extra>`,
  })), () => ({
    height: Math.max(170, 60 + 20 * names.length), xaxis: { type: "date", title: { text: `local time (${Intl.DateTimeFormat().resolvedOptions().timeZone})` } },
    yaxis: { autorange: "reversed", type: "category", categoryarray: names, showticklabels: !narrow() }, margin: { l: 10, t: 4 },
  }));
}

function facts(table, pairs) {
  table.replaceChildren(...pairs.map(([name, value]) => {
    const line = document.createElement("tr"), head = document.createElement("th"), cell = document.createElement("td");
    head.textContent = name;
    cell.textContent = value;
    line.append(head, cell);
    return line;
  }));
}

function drawLamp(lamp) {
  byId("lampwords").textContent = lamp.told;
  draw(byId("lamp"), () => [{ x: lamp.states, y: lamp.ratio.map(v => 100 * (v - 1)), mode: "markers+lines", line: { width: 1, color: accent() }, marker: { size: 4 },
    hovertemplate: "state %{x}: %{y:+.2f} %<extra></extra>" }],
    () => ({ xaxis: { title: { text: "state" } }, yaxis: { title: { text: "lamp / %" }, zerolinecolor: quiet() }, margin: { t: 4 } }));
}

/** Times of the log as the clock on the wall has them. */
function localTimes() {
  for (const time of document.querySelectorAll("time")) time.textContent = local(time.dateTime).slice(0, 19).replace("T", " ");
}

/** Grid with its links, timeline and log, once the log has another line; what runs stays as it is. */
async function renew(now) {
  const newest = JSON.stringify(now.logged);
  if (logged === newest) return;
  logged = newest;
  const page = new DOMParser().parseFromString(await (await fetch(location)).text(), "text/html");
  const fresh = page.querySelectorAll("[data-renewed]");
  if (byId("timeline")) Plotly.purge(byId("timeline"));
  document.querySelectorAll("[data-renewed]").forEach((part, k) => part.replaceWith(fresh[k]));
  timeline();
  localTimes();
}

/** Signs of the grid as they change. */
function grid(now) {
  const signs = embedded("signs");
  document.querySelectorAll(".cell[data-name]").forEach(cell => {
    const status = now.cells?.[cell.dataset.name];
    if (!status || cell.classList.contains(status)) return;
    cell.className = `cell ${status}`;
    cell.textContent = signs[status] ?? "";
    cell.title = `${cell.dataset.name}: ${status}`;
    cell.setAttribute("aria-label", cell.title);
  });
  byId("complete").textContent = `${now.complete} of ${now.total}`;
}

async function lastFrame(now) {
  if (!now.file || !now.states || (shown.file === now.file && shown.states === now.states)) return;
  shown = now;
  if (!view) {
    const states = await getJson("states", { file: now.file });
    view = new ImageView(byId("frame"), {
      shape: states.shape,
      read: (window, signal) => readPlane("frame", { file: shown.file, state: -1, ...window }, signal),
      traces: plane => [
        { type: "heatmap", z: plane.planes[0], ...place(plane), zmin: states.black, zmax: states.saturation ?? undefined, colorscale: [[0, "#000"], [1, "#fff"]],
          hovertemplate: "%{z:.0f} counts<extra></extra>", colorbar: { title: { text: "counts", side: "right" }, thickness: 10, outlinewidth: 0 } },
        ...saturated(plane),
      ],
    });
  }
  await view.refresh();
}

function show(now) {
  const was = !run.hidden;
  run.hidden = !now.running;
  if (byId("resume")) byId("resume").hidden = now.running;
  if (was && !now.running) return location.reload();
  if (!now.running) return undefined;
  byId("title").textContent = now.title || now.activity;
  byId("captures").textContent = `${now.number} of ${now.total}`;
  byId("states").textContent = `${now.done} of ${now.pending}`;
  byId("left").textContent = duration(now.left_s);
  byId("night").textContent = duration(now.night_s);
  byId("progress").max = now.pending || 1;
  byId("progress").value = now.done;
  byId("activity").textContent = now.activity;
  grid(now);
  renew(now).catch(() => { logged = ""; });
  facts(byId("axes"), Object.entries(now.axes));
  if (now.lamp) drawLamp(now.lamp);
  byId("messages").replaceChildren(...(now.messages.length ? now.messages : ["none"]).map(text => {
    const line = document.createElement("div");
    line.textContent = text;
    return line;
  }));
  // A capture that was just sealed has lost its partial name: the next event brings the new one.
  return lastFrame(now).catch(() => { shown = {}; });
}

byId("stop").addEventListener("click", async event => {
  event.target.disabled = true;
  event.target.textContent = "Stopping after this state ...";
  try { await post("stop", { folder }); } catch (error) {
    event.target.disabled = false;
    event.target.textContent = "Stop after this state";
    say(byId("messages"), error);
  }
});

addEventListener("load", () => {
  timeline();
  localTimes();
  const events = new EventSource(at("events", { folder }));
  events.onmessage = event => show(JSON.parse(event.data));
  document.body.dataset.ready = "yes";
});
