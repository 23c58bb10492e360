// Getting a portrait: drop, pick, paste, or the sample; several faces to choose from.

import { element } from "./dom.js";

const THUMBNAIL = 72;

/** Calls `take(file)` for a portrait that was dropped, picked or pasted. */
export function listen(drop, input, take) {
  input.addEventListener("change", () => {
    if (input.files[0]) take(input.files[0]);
    input.value = ""; // the same file again is a change, too
  });
  for (const name of ["dragenter", "dragover"]) {
    drop.addEventListener(name, (event) => {
      event.preventDefault();
      drop.classList.add("over");
    });
  }
  for (const name of ["dragleave", "drop"]) {
    drop.addEventListener(name, () => drop.classList.remove("over"));
  }
  drop.addEventListener("drop", (event) => {
    event.preventDefault();
    if (event.dataTransfer.files[0]) take(event.dataTransfer.files[0]);
  });
  // A file dropped beside the target must not replace the page.
  for (const name of ["dragover", "drop"]) {
    window.addEventListener(name, (event) => event.preventDefault());
  }
  window.addEventListener("paste", (event) => {
    const file = [...event.clipboardData.files].find((one) => one.type.startsWith("image/"));
    if (file) take(file);
  });
}

/** Buttons with the faces of a portrait; `choose(number)` is called for the one pressed. */
export async function faceButtons(file, boxes, choose) {
  const bitmap = await createImageBitmap(file);
  return boxes.map(([left, top, right, bottom], number) => {
    const canvas = element("canvas", { width: THUMBNAIL, height: THUMBNAIL });
    const side = Math.max(right - left, bottom - top) * 1.4;
    const [x, y] = [(left + right - side) / 2, (top + bottom - side) / 2];
    canvas.getContext("2d").drawImage(bitmap, x, y, side, side, 0, 0, THUMBNAIL, THUMBNAIL);
    const button = element("button", { type: "button" }, canvas);
    button.setAttribute("aria-label", `Use face ${number + 1}`);
    button.addEventListener("click", () => choose(number));
    return button;
  });
}
