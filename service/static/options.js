// What the fields above the sliders say, in the service's words.

import { $ } from "./dom.js";

/** The `output` of a render. */
export function output() {
  const choice = $("background").value;
  const background = choice === "colour" ? $("colour").value : choice;
  return { size: Number($("size").value), background };
}

/** The terms of a stream. */
export function hello() {
  // JPEG is the fastest, but has no transparency.
  const codec = output().background === "transparent" ? "webp" : "jpeg";
  return {
    mode: $("mode").value,
    camera: $("follow").value,
    output: { codec, quality: 80, ...output() },
  };
}
