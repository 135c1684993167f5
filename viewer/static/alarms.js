// Alarms of the guard, on every page: shown while they last, acknowledged by their button.

import { byId, post, pressed, say } from "./plots.js";

const alarms = byId("alarms"), every_ms = 5000;

function buttons() {
  for (const button of alarms.querySelectorAll("button")) pressed(button, async () => {
    button.disabled = true;
    try { await post("acknowledge", { name: button.dataset.alarm }); } catch (error) { return say(alarms, error); }
    return renew();
  });
}

async function renew() {
  const answer = await fetch(`${document.documentElement.dataset.root}/alarms`);
  const text = answer.ok ? await answer.text() : null;
  if (text === null || text === alarms.dataset.shown) return;
  alarms.dataset.shown = text;
  alarms.replaceChildren(...new DOMParser().parseFromString(text, "text/html").body.children);
  buttons();
}

buttons();
setInterval(() => { if (!document.hidden) renew().catch(() => {}); }, every_ms);
