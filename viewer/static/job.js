// The page of a command: its output as it comes, and what it has made.

import { at, byId, embedded, post, say } from "./plots.js";

const name = byId("job").dataset.name, output = byId("output");

function show(now) {
  const atEnd = output.scrollHeight - output.scrollTop - output.clientHeight < 40;
  output.textContent = now.output || "nothing said yet";
  if (atEnd) output.scrollTop = output.scrollHeight;
  byId("status").textContent = now.status;
  byId("status").className = `badge ${now.status}`;
  byId("stop").hidden = now.status !== "running";
  byId("working").hidden = now.status !== "running";
  byId("links").replaceChildren(...now.links.map(([text, address], k) => {
    const link = document.createElement("a");
    link.className = k ? "button" : "button main";
    link.textContent = text;
    link.href = address;
    return link;
  }));
}

show(embedded("now"));
byId("stop").addEventListener("click", async event => {
  event.target.disabled = true;
  try { await post("stop-job", { name }); } catch (error) { say(byId("problem"), error); }
});
const events = new EventSource(at("job-events", { name }));
events.onmessage = event => {
  const now = JSON.parse(event.data);
  show(now);
  if (now.status !== "running" && now.status !== "ended") events.close();
};
document.body.dataset.ready = "yes";
