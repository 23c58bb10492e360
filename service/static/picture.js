// The picture on the page: replaced only by what is decoded already, so that nothing flickers.

import { markPng } from "./mark.js";

export class Picture {
  #image;
  #blob = null;

  constructor(image) {
    this.#image = image;
  }

  async show(blob, description) {
    const address = URL.createObjectURL(blob);
    const decoded = new Image();
    decoded.src = address;
    try {
      await decoded.decode();
    } catch (error) {
      URL.revokeObjectURL(address);
      throw error;
    }
    const old = this.#image.src;
    this.#image.src = address;
    this.#image.alt = description;
    this.#image.hidden = false;
    this.#blob = blob;
    if (old) URL.revokeObjectURL(old);
  }

  clear() {
    if (this.#image.src) URL.revokeObjectURL(this.#image.src);
    this.#image.removeAttribute("src");
    this.#image.hidden = true;
    this.#blob = null;
  }

  /** What is shown, as a PNG that carries the mark; `source` is its digital source type. */
  async png(source) {
    if (!this.#blob || this.#blob.type === "image/png") return this.#blob;
    const bitmap = await createImageBitmap(this.#blob);
    const canvas = document.createElement("canvas");
    [canvas.width, canvas.height] = [bitmap.width, bitmap.height];
    canvas.getContext("2d").drawImage(bitmap, 0, 0);
    const plain = await new Promise((resolve) => { canvas.toBlob(resolve, "image/png"); });
    return markPng(plain, source);
  }
}
