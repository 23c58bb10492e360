// What the page says: errors with a remedy, work under way, and words for screen readers.

import { ServiceError } from "./api.js";
import { $ } from "./dom.js";

/** Show an error until the next success, or until it is dismissed. */
export function complain(error) {
  if (!(error instanceof ServiceError)) console.error(error);
  $("alert-detail").textContent = error.message;
  $("alert-hint").textContent = error.hint ?? "";
  $("faces").replaceChildren();
  $("alert").hidden = false;
  if (error.status === 401) {
    $("key-box").open = true;
    $("key").focus();
  }
}

export function quiet() {
  $("alert").hidden = true;
  $("faces").replaceChildren();
}

/** A line over the picture; empty for none. */
export function busy(text) {
  $("badge").textContent = text;
  $("badge").hidden = !text;
  $("badge").classList.toggle("busy", text.endsWith("…"));
}

export function announce(text) {
  $("announce").textContent = text;
}
