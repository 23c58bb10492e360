// What happened lately: frames per second and latency.

const SPAN = 3000; // milliseconds

export class Meter {
  #shown = [];

  clear() {
    this.#shown = [];
  }

  /** A picture was shown, `latency` milliseconds after it was asked for. */
  add(latency, server = null, now = performance.now()) {
    this.#shown.push({ now, latency, server });
    this.#shown = this.#shown.filter((frame) => now - frame.now < SPAN);
  }

  get fps() {
    const idle = performance.now() - (this.#shown.at(-1)?.now ?? 0) > SPAN;
    if (idle || this.#shown.length < 2) return null;
    const [first, last] = [this.#shown[0], this.#shown.at(-1)];
    return ((this.#shown.length - 1) * 1000) / Math.max(1, last.now - first.now);
  }

  /** Median milliseconds over the last seconds. */
  get latency() {
    return median(this.#shown.map((frame) => frame.latency));
  }

  get server() {
    return median(this.#shown.map((frame) => frame.server).filter((value) => value !== null));
  }
}

function median(values) {
  if (!values.length) return null;
  return values.toSorted((a, b) => a - b)[Math.floor(values.length / 2)];
}
