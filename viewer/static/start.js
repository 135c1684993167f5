// Forms that start something: what they hold is sent, and the page that follows it is opened.

import { post, say } from "./plots.js";

document.querySelectorAll("form[data-start]").forEach(form => form.addEventListener("submit", async event => {
  event.preventDefault();
  const fields = { what: form.dataset.start };
  for (const [name, value] of new FormData(form)) fields[name] = name in fields ? `${fields[name]}\n${value}` : value;
  const button = form.querySelector("button:not([type=button])");
  button.disabled = true;
  try {
    location.href = (await post("start", fields)).address;
  } catch (error) {
    button.disabled = false;
    const place = form.querySelector(".answer") || form.appendChild(document.createElement("div"));
    place.className = "answer";
    say(place, error);
  }
}));
