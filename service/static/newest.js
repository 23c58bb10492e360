// One request at a time: while it runs, only the newest wish is kept.

export class Newest {
  #work;
  #running = false;
  #next = null;

  /** Wishes that a newer one replaced. */
  dropped = 0;

  /** `work(wish)` is awaited; it handles its own errors. */
  constructor(work) {
    this.#work = work;
  }

  async ask(wish) {
    if (this.#next !== null) this.dropped += 1;
    this.#next = wish;
    if (this.#running) return;
    this.#running = true;
    try {
      while (this.#next !== null) {
        const current = this.#next;
        this.#next = null;
        await this.#work(current);
      }
    } finally {
      this.#running = false;
    }
  }

  cancel() {
    this.#next = null;
  }
}
