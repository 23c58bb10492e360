// The HTTP side: requests, and errors that say what to do next.

/** An answer other than success, as RFC 9457 tells it. */
export class ServiceError extends Error {
  constructor(problem) {
    super(problem.detail || problem.title || "The server refused the request.");
    this.name = "ServiceError";
    this.hint = problem.hint ?? "";
    this.code = problem.code ?? "";
    this.status = problem.status ?? 0;
    this.boxes = problem.boxes ?? [];
    this.retryAfter = problem.retryAfter ?? null;
  }
}

export class Api {
  /** The key lives in this object only: no cookie, no storage, no address. */
  key = "";

  async create(image, { consent, face }) {
    const query = new URLSearchParams({ consent: String(consent) });
    // Without a chosen face the server may say that there are several.
    if (face !== undefined) query.set("face", String(face));
    const headers = { "Content-Type": image.type || "application/octet-stream" };
    const answer = await this.#send(`/v1/avatars?${query}`, { method: "POST", headers, body: image });
    return answer.json();
  }

  async delete(avatar) {
    await this.#send(`/v1/avatars/${avatar}`, { method: "DELETE" });
  }

  /** @returns {{blob: Blob, milliseconds: number|null}} picture and time spent on the server */
  async render(avatar, request) {
    const answer = await this.#send(`/v1/avatars/${avatar}/render`, {
      method: "POST",
      headers: { "Content-Type": "application/json", Accept: "image/png" },
      body: JSON.stringify(request),
    });
    const timing = answer.headers.get("Server-Timing");
    return { blob: await answer.blob(), milliseconds: timing && total(timing) };
  }

  /** Browsers cannot put a key on a WebSocket, and a key in an address ends up in logs. */
  async ticket() {
    const answer = await this.#send("/v1/tickets", { method: "POST" });
    return (await answer.json()).ticket;
  }

  async #send(path, options) {
    const headers = { ...options.headers };
    if (this.key) headers.Authorization = `Bearer ${this.key}`;
    let answer;
    try {
      answer = await fetch(path, { ...options, headers, cache: "no-store" });
    } catch {
      throw new ServiceError({
        detail: "The server does not answer.",
        hint: "Check that it still runs, then try again.",
      });
    }
    if (!answer.ok) throw new ServiceError(await problem(answer));
    return answer;
  }
}

async function problem(answer) {
  const retryAfter = Number(answer.headers.get("Retry-After")) || null;
  const fallback = { status: answer.status, detail: `${answer.status} ${answer.statusText}` };
  try {
    return { ...fallback, retryAfter, ...(await answer.json()) };
  } catch {
    return { ...fallback, retryAfter };
  }
}

/** Sum of the stages of a Server-Timing header, milliseconds. */
function total(timing) {
  const stages = [...timing.matchAll(/([\w-]+);[^,]*?dur=([\d.]+)/g)];
  const whole = stages.find(([, name]) => name === "total");
  return whole ? Number(whole[2]) : stages.reduce((sum, [, , dur]) => sum + Number(dur), 0);
}
