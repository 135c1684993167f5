// Forms that start something: what they hold is sent, and the page that follows it is opened. And the note of a file.

import { post, say } from "./plots.js";

async function start(event) {
  event.preventDefault();
  const form = event.target, button = buttonOf(form);
  const fields = { what: form.dataset.start };
  for (const [name, value] of new FormData(form)) fields[name] = name in fields ? `${fields[name]}\n${value}` : value;
  button.disabled = true;
  try {
    location.href = (await post("start", fields)).address;
  } catch (error) {
    button.disabled = false;
    const place = form.querySelector(".answer") || form.appendChild(document.createElement("div"));
    place.className = "answer";
    say(place, error);
  }
}

const buttonOf = form => form.querySelector("button:not([type=button])");
const forms = document.querySelectorAll("form[data-start]");
forms.forEach(form => form.addEventListener("submit", start));
// Pages send these buttons disabled: a form that is sent before this script has come would leave the page.
const enable = () => forms.forEach(form => { buttonOf(form).disabled = false; });
enable();
// A page that is gone back to is as it was left.
addEventListener("pageshow", event => { if (event.persisted) enable(); });

const note = document.getElementById("file-note");
note?.addEventListener("submit", async event => {
  event.preventDefault();
  const answer = note.querySelector("[role=status]"), { tags, text } = note.elements;
  try {
    const kept = await post("note", { file: note.dataset.file, tags: tags.value, text: text.value });
    tags.value = kept.tags.join(", ");
    answer.textContent = "kept";
  } catch (error) {
    say(answer, error);
  }
});
if (note) buttonOf(note).disabled = false;
