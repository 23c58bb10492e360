// Binary frames of the stream, protocol version 1 (docs/streaming.md).

export const VERSION = 1;
export const TYPE = { DRIVING: 2, RENDERED: 3, ACK: 4, STATS: 5, REFERENCE: 6 };
export const CODEC = { NONE: 0, JPEG: 1, PNG: 2, WEBP: 3 };
export const MEDIA_TYPES = { 1: "image/jpeg", 2: "image/png", 3: "image/webp" };
const MAGIC = 0xc7;
const HEADER = 24;

/** Header and payload (ArrayBuffer or nothing) in one buffer. */
export function pack({ type, codec = CODEC.NONE, sequence, captured = 0, payload }) {
  const body = new Uint8Array(payload ?? 0);
  const bytes = new Uint8Array(HEADER + body.length);
  const view = new DataView(bytes.buffer);
  view.setUint8(0, MAGIC);
  view.setUint8(1, VERSION);
  view.setUint8(2, type);
  view.setUint8(3, codec);
  view.setUint32(4, sequence >>> 0, true);
  view.setBigUint64(8, BigInt(Math.round(captured * 1000)), true);
  view.setUint32(16, body.length, true);
  bytes.set(body, HEADER);
  return bytes.buffer;
}

/** @throws {Error} not a frame of this protocol */
export function unpack(buffer) {
  const view = new DataView(buffer);
  if (buffer.byteLength < HEADER || view.getUint8(0) !== MAGIC || view.getUint8(1) !== VERSION) {
    throw new Error("not a frame of stream protocol 1");
  }
  const length = view.getUint32(16, true);
  if (buffer.byteLength !== HEADER + length) throw new Error("a frame of the wrong length");
  return {
    type: view.getUint8(2),
    codec: view.getUint8(3),
    sequence: view.getUint32(4, true),
    captured: Number(view.getBigUint64(8, true)) / 1000,
    payload: buffer.slice(HEADER),
  };
}
