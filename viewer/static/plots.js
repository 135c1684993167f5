// What the plots of all pages share: colours of the page, scales as in print, and pictures read from the server.

const root = document.documentElement.dataset.root;
export const at = (what, query = {}) => {
  const given = Object.entries(query).filter(([, value]) => value !== null && value !== undefined);
  return `${root}/${what}?${new URLSearchParams(given)}`;
};
export const byId = id => document.getElementById(id);
export const embedded = id => JSON.parse(byId(id).textContent);

export async function getJson(what, query) {
  const answer = await fetch(at(what, query));
  if (!answer.ok) throw new Error(await answer.text());
  return answer.json();
}

/** Makes a function that reads JSON for the newest question alone: an older answer that comes later gives null. */
export function newestJson() {
  let newest = 0;
  return async (what, query) => {
    const mine = ++newest;
    const found = await getJson(what, query);
    return mine === newest ? found : null;
  };
}

export async function post(what, fields) {
  const answer = await fetch(`${root}/${what}`, { method: "POST", body: JSON.stringify(fields) });
  if (!answer.ok) throw new Error(await answer.text());
  return answer.json();
}

/** What a button does. Pages send it disabled: one that is pressed before its script has come would do nothing, or leave the page. */
export function pressed(button, act) {
  button.addEventListener("click", act);
  button.disabled = false;
}

/** A button that copies lines of cells as a spreadsheet takes them, and says so. */
export const copies = (button, lines, told, problem) => pressed(button, async () => {
  try {
    await navigator.clipboard.writeText(lines().map(line => line.join("\t")).join("\n"));
    told.textContent = "copied";
  } catch (error) { say(problem, error); }
});

export function say(where, error) {
  const line = document.createElement("p");
  line.className = "error";
  line.setAttribute("role", "alert");
  line.textContent = error.message || String(error);
  where.replaceChildren(line);
}

const colour = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const dark = matchMedia("(prefers-color-scheme: dark)");
export const narrow = () => innerWidth < 640;

export function layout(more = {}) {
  const ink = colour("--ink"), line = colour("--line");
  const axis = { gridcolor: line, zerolinecolor: line, linecolor: line, automargin: true, ticks: "outside", tickcolor: line };
  const { xaxis, yaxis, margin, ...rest } = more;
  return {
    paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
    font: { color: ink, family: "system-ui, DejaVu Sans, sans-serif", size: 12 },
    margin: { l: 52, r: 12, t: 10, b: 40, ...margin }, showlegend: false, hovermode: "closest", uirevision: "kept",
    legend: { orientation: "h", y: 1.02, yanchor: "bottom", x: 0 },
    xaxis: { ...axis, ...xaxis }, yaxis: { ...axis, ...yaxis }, ...rest,
  };
}

const settings = node => ({
  responsive: true, displaylogo: false, scrollZoom: Boolean(node.dataset.wheel),
  modeBarButtonsToRemove: ["lasso2d", "select2d", "autoScale2d"],
});

// The plotting library is the last script of a page: what a plot shows is read while the browser compiles it.
const library = new Promise(done => addEventListener("load", done));

const drawn = new Map();
/** Draw a plot; it is drawn again with the colours of the page when those change. */
export async function draw(node, traces, more) {
  drawn.set(node, [traces, more]);
  if (!globalThis.Plotly) await library;
  while (!node.layout && dragging()) await new Promise(done => setTimeout(done, 50));
  const [newest, withMore] = drawn.get(node);
  return Plotly.react(node, newest(), layout(withMore()), settings(node));
}

// A new plot clears Plotly's timers of all others: a drag in one of them would never end, so it is waited for.
let released = -Infinity;
addEventListener("pointerup", () => { released = performance.now(); }, true);
const dragging = () => document.querySelector(".dragcover") !== null || performance.now() - released < 150;

dark.addEventListener("change", () => drawn.forEach(([traces, more], node) => {
  const kept = ["xaxis", "yaxis"].map(name => node.layout?.[name]?.range);
  const fresh = more();
  fresh.xaxis = { ...fresh.xaxis, range: kept[0] };
  fresh.yaxis = { ...fresh.yaxis, range: kept[1] };
  Plotly.react(node, traces(), layout(fresh), settings(node));
}));

export const ink = () => colour("--ink");
export const accent = () => colour("--accent");
export const bad = () => colour("--bad");
export const warn = () => colour("--warn");
export const quiet = () => colour("--quiet");
export const statusColour = status => ({
  done: "#2e7d4f", flagged: "#e0a030", partial: "#e0a030", failed: "#b3261e", running: accent(),
})[status] || quiet();

/** A value with its errors: each with two digits, the value as far as the smallest of them reaches. */
export function measured(value, errors) {
  const known = errors.filter(e => e !== null && e !== undefined && e > 0 && Number.isFinite(e)).map(e => Number(e.toPrecision(2)));
  const least = known.length ? Math.floor(Math.log10(Math.min(...known))) - 1 : null;
  const shown = v => {
    if (v === null || v === undefined) return "?";
    if (v === 0 || least === null) return String(Number(v.toPrecision(6)));
    if (least > 0) return String(Math.round(v / 10 ** least) * 10 ** least);
    return least < -12 ? v.toPrecision(6) : v.toFixed(-least);
  };
  return value === null || value === undefined ? "-" : [value, ...errors].map(shown).join(" ± ").replace(/^-(?=[0.]+ )/, "");
}

export function duration(seconds) {
  if (seconds === null || seconds === undefined) return "not known yet";
  if (seconds < 90) return `${Math.round(seconds)} s`;
  if (seconds < 5400) return `${Math.round(seconds / 60)} min`;
  return `${Math.floor(seconds / 3600)} h ${Math.round(seconds % 3600 / 60)} min`;
}
