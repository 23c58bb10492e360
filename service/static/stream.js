// Webcam mode: camera frames go out over the WebSocket, rendered frames come back.

import { ServiceError } from "./api.js";
import { CODEC, MEDIA_TYPES, TYPE, VERSION, pack, unpack } from "./wire.js";

const FRAMES_PER_SECOND = 25;
const DRIVING_WIDTH = 480;
const DRIVING_QUALITY = 0.85;
// More waiting bytes than this: the uplink is the bottleneck, and a late frame is a useless one.
const MAX_BUFFERED = 64 * 1024;

const CLOSED = {
  1001: ["The server is stopping.", "Start the webcam again in a moment."],
  1006: ["The connection to the server was lost.", "Check that it still runs, then try again."],
  1008: ["The server refused the stream.", "Check the API key and the address of this page."],
  1009: ["A frame was too large for the server.", "Use a camera with a lower resolution."],
  1013: ["The server has too much to do.", "Try again in a moment."],
  4404: ["The server does not know this avatar.", "Upload the portrait again."],
  4410: ["This avatar has expired.", "Upload the portrait again."],
  4409: ["The model has changed since this avatar was made.", "Upload the portrait again."],
};

export class Stream {
  #video;
  #socket = null;
  #media = null;
  #canvas = document.createElement("canvas");
  #events;
  #sequence = 0;
  #last = -Infinity;
  #encoding = false;
  #reference = false;
  #shown = Promise.resolve();
  #answered = null;
  #refusal = null;

  /**
   * `events`: welcome(hello), frame(blob, latency()) -> Promise, stats(counts), ended(error).
   */
  constructor(video, events) {
    this.#video = video;
    this.#events = events;
  }

  /** Resolves when both sides have said hello and frames flow. */
  async start({ avatar, ticket, hello }) {
    try {
      this.#media = await openCamera();
      this.#video.srcObject = this.#media;
      await this.#video.play();
      await this.#connect(avatar, ticket, hello);
    } catch (error) {
      this.stop();
      throw error;
    }
    // Relative motion needs something to be relative to.
    this.#reference = hello.mode === "relative";
    this.#media.getVideoTracks()[0].addEventListener("ended", () => {
      this.#end(new ServiceError({ detail: "The camera was disconnected.", hint: "" }));
    });
    this.#nextFrame();
  }

  /** The next camera frame is the face that counts as neutral. */
  setReference() {
    this.#reference = true;
  }

  stop() {
    const socket = this.#socket;
    this.#socket = null;
    socket?.close(1000);
    for (const track of this.#media?.getTracks() ?? []) track.stop();
    this.#media = null;
    this.#video.srcObject = null;
  }

  #connect(avatar, ticket, hello) {
    const address = new URL(`/v1/avatars/${avatar}/stream`, location.href);
    address.protocol = location.protocol === "https:" ? "wss:" : "ws:";
    if (ticket) address.searchParams.set("ticket", ticket);
    const socket = new WebSocket(address);
    socket.binaryType = "arraybuffer";
    this.#socket = socket;
    this.#refusal = null;
    socket.onopen = () => socket.send(JSON.stringify({
      type: "hello", versions: [VERSION], window: 2, smooth: true, ...hello,
    }));
    return new Promise((resolve, reject) => {
      this.#answered = resolve;
      socket.onmessage = ({ data }) => this.#receive(data);
      socket.onclose = (event) => {
        const error = this.#refusal ?? closed(event);
        reject(error);
        if (this.#socket === socket) this.#end(error);
      };
    });
  }

  #receive(data) {
    if (typeof data === "string") {
      const message = JSON.parse(data);
      if (message.type === "error") this.#refusal = new ServiceError(message);
      if (message.type !== "hello") return;
      this.#events.welcome(message);
      this.#answered();
      return;
    }
    const frame = unpack(data);
    if (frame.type === TYPE.STATS) {
      this.#events.stats(JSON.parse(new TextDecoder().decode(frame.payload)));
    } else if (frame.type === TYPE.RENDERED) {
      // At most `window` frames are under way, so this chain stays short.
      this.#shown = this.#shown.then(() => this.#show(frame));
    }
  }

  async #show(frame) {
    const socket = this.#socket;
    if (!socket) return;
    const blob = new Blob([frame.payload], { type: MEDIA_TYPES[frame.codec] });
    await this.#events.frame(blob, () => performance.now() - frame.captured);
    if (socket.readyState === WebSocket.OPEN) {
      socket.send(pack({ type: TYPE.ACK, sequence: frame.sequence, captured: frame.captured }));
    }
  }

  #nextFrame() {
    if (!this.#socket) return;
    const again = () => {
      this.#send();
      this.#nextFrame();
    };
    if (this.#video.requestVideoFrameCallback) this.#video.requestVideoFrameCallback(again);
    else setTimeout(again, 1000 / FRAMES_PER_SECOND);
  }

  async #send() {
    const socket = this.#socket;
    const captured = performance.now();
    const early = captured - this.#last < 1000 / FRAMES_PER_SECOND - 4;
    const busy = this.#encoding || socket?.bufferedAmount > MAX_BUFFERED;
    if (!socket || socket.readyState !== WebSocket.OPEN || early || busy) return;
    this.#last = captured;
    this.#encoding = true;
    try {
      const payload = await this.#jpeg();
      if (!payload || socket.readyState !== WebSocket.OPEN) return;
      if (this.#reference) {
        this.#reference = false;
        this.#put(socket, TYPE.REFERENCE, captured, payload);
      }
      this.#put(socket, TYPE.DRIVING, captured, payload);
    } finally {
      this.#encoding = false;
    }
  }

  #put(socket, type, captured, payload) {
    this.#sequence += 1;
    socket.send(pack({ type, codec: CODEC.JPEG, sequence: this.#sequence, captured, payload }));
  }

  async #jpeg() {
    const { videoWidth, videoHeight } = this.#video;
    if (!videoWidth) return null;
    const scale = Math.min(1, DRIVING_WIDTH / Math.min(videoWidth, videoHeight));
    const canvas = this.#canvas;
    canvas.width = Math.round(videoWidth * scale);
    canvas.height = Math.round(videoHeight * scale);
    canvas.getContext("2d").drawImage(this.#video, 0, 0, canvas.width, canvas.height);
    const blob = await new Promise((resolve) => {
      canvas.toBlob(resolve, "image/jpeg", DRIVING_QUALITY);
    });
    return blob?.arrayBuffer();
  }

  #end(error) {
    this.stop();
    this.#events.ended(error);
  }
}

function closed({ code, reason }) {
  const [detail, hint] = CLOSED[code] ?? [`The stream was closed (${code}).`, "Try again."];
  return new ServiceError({ detail, hint: reason || hint, status: code });
}

async function openCamera() {
  if (!navigator.mediaDevices) {
    throw new ServiceError({
      detail: "The browser gives no camera to this address.",
      hint: "Open the page over https, or as http://localhost on the same machine.",
    });
  }
  try {
    return await navigator.mediaDevices.getUserMedia({
      audio: false,
      video: { width: { ideal: 640 }, height: { ideal: 480 }, facingMode: "user" },
    });
  } catch (error) {
    const refused = error.name === "NotAllowedError";
    throw new ServiceError({
      detail: refused ? "The camera was not allowed." : "No camera could be opened.",
      hint: refused
        ? "Allow the camera for this page in the browser's address bar."
        : "Connect one, and close other programs that use it.",
    });
  }
}
