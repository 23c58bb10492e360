// Parts of the page that know nothing of avatars: figures, copy buttons, the key's field.

import { $, sleep } from "./dom.js";
import { announce } from "./messages.js";

/** Show a Meter's figures, four times a second. */
export function keepFigures(meter) {
  const text = (value, digits, unit) => (value === null ? "–" : `${value.toFixed(digits)}${unit}`);
  setInterval(() => {
    $("stat-fps").textContent = text(meter.fps, 1, "");
    $("stat-latency").textContent = text(meter.latency, 0, " ms");
    $("stat-server").textContent = text(meter.server, 0, " ms");
  }, 250);
}

/** Let every button with data-copy="ID" copy the text of that element. */
export function copyButtons() {
  for (const button of document.querySelectorAll("[data-copy]")) {
    button.addEventListener("click", async () => {
      await copy($(button.dataset.copy).textContent);
      announce("Copied.");
      button.textContent = "Copied";
      await sleep(1500);
      button.textContent = "Copy";
    });
  }
}

/** Calls `changed(key)`; the key's box closes like any menu. */
export function askForKey(changed) {
  const box = $("key-box");
  $("key").addEventListener("input", () => changed($("key").value.trim()));
  $("key-form").addEventListener("submit", (event) => {
    event.preventDefault();
    box.open = false;
  });
  document.addEventListener("keydown", (event) => {
    if (event.key !== "Escape" || !box.open) return;
    box.open = false;
    box.querySelector("summary").focus();
  });
  document.addEventListener("pointerdown", (event) => {
    if (!box.contains(event.target)) box.open = false;
  });
}

/** To the clipboard, also where the browser only gives it to secure pages. */
async function copy(text) {
  try {
    await navigator.clipboard.writeText(text);
  } catch {
    const area = document.createElement("textarea");
    area.value = text;
    document.body.append(area);
    area.select();
    document.execCommand("copy");
    area.remove();
  }
}
