// The current request as text: JSON, and a curl line that works as pasted.

const quoted = (text) => `'${text.replaceAll("'", "'\\''")}'`;

/** Indented JSON with the numbers of an array on one line. */
export function pretty(value) {
  return JSON.stringify(value, null, 2)
    .replace(/\[\s+([-\d.e,\s]+?)\s+\]/g, (_, list) => `[${list.replace(/\s+/g, " ")}]`);
}

/** `keyed`: the server wants a key; the line names a variable, never the key itself. */
export function renderLine(avatar, request, keyed) {
  return line([
    address(`/v1/avatars/${avatar}/render`),
    ...authorization(keyed),
    "-H 'Content-Type: application/json'",
    "-H 'Accept: image/png'",
    `-d ${quoted(JSON.stringify(request))}`,
    "-o frame.png",
  ]);
}

/** One camera frame over HTTP: what the stream does for many. */
export function driveLine(avatar, hello, keyed) {
  const query = new URLSearchParams({
    camera: hello.camera, size: hello.output.size, background: hello.output.background,
  });
  return line([
    address(`/v1/avatars/${avatar}/drive?${query}`),
    ...authorization(keyed),
    "-H 'Accept: image/png'",
    "-F image=@camera.jpg",
    ...(hello.mode === "relative" ? ["-F reference=@neutral.jpg"] : []),
    "-o frame.png",
  ]);
}

const address = (path) => quoted(location.origin + path);
const authorization = (keyed) => (keyed ? ['-H "Authorization: Bearer $CVTHEAD_KEY"'] : []);
const line = (parts) => ["curl --fail-with-body -sS", ...parts].join(" \\\n  ");
