// The page: what happens when, and what is shown.

import { Api } from "./api.js";
import { Controls } from "./controls.js";
import { $, element, sleep } from "./dom.js";
import { announce, busy, complain, quiet } from "./messages.js";
import { Newest } from "./newest.js";
import { hello, output } from "./options.js";
import { askForKey, copyButtons, keepFigures } from "./panel.js";
import { Picture } from "./picture.js";
import { faceButtons, listen } from "./portrait.js";
import { driveLine, pretty, renderLine } from "./request.js";
import { PRESETS } from "./sliders.js";
import { Meter } from "./stats.js";
import { Stream } from "./stream.js";

const GONE = new Set([
  "avatar_not_found", "avatar_expired", "model_changed", "invalid_avatar_file",
  4404, 4410, 4409, // how a stream says so
]);
const MODE_HINTS = {
  relative: "Every slider at rest shows the portrait as it is; movements add to it.",
  absolute: "Values replace the portrait's. The first face slider that moves starts from a "
    + "neutral face.",
};
const ALT = "AI-generated picture of the portrait, moved by your settings";

const api = new Api();
const picture = new Picture($("picture"));
const meter = new Meter();
const controls = new Controls($("groups"), changed);
const renders = new Newest(render);
const starts = new Newest(openStream);
const stream = new Stream($("camera-view"), {
  welcome: (answer) => { sourceType = answer.digital_source_type; },
  frame: streamed,
  stats: counted,
  ended: (error) => { stopCamera(); failed(error); },
});
let avatar = null;
let streaming = false;
let sourceType = "";
let lostFaces = 0;

// Portrait ---------------------------------------------------------------------------------

listen($("drop"), $("file"), (file) => {
  if (avatar || $("start").hidden) return;
  if (!$("consent").checked) {
    $("consent").parentElement.classList.add("wanted");
    $("consent").focus();
    waiting = file;
    announce("Please confirm that the person agreed.");
    return;
  }
  create(file, {});
});

// A portrait that was chosen before the box was ticked.
let waiting = null;
$("consent").addEventListener("change", () => {
  $("consent").parentElement.classList.remove("wanted");
  if ($("consent").checked && waiting) create(waiting, {});
  waiting = null;
});

$("sample").addEventListener("click", async () => {
  const answer = await fetch("/static/sample.jpg");
  create(await answer.blob(), {});
});

async function create(file, { face }) {
  const focused = $("start").contains(document.activeElement) || $("alert").contains(document.activeElement);
  quiet();
  busy("Reading the portrait …");
  $("start").inert = true;
  try {
    // The sample may be animated; for any other picture the box is ticked before.
    avatar = await api.create(file, { consent: true, face });
  } catch (error) {
    complain(error);
    if (error.boxes?.length) {
      const again = (number) => create(file, { face: number });
      $("faces").replaceChildren(...(await faceButtons(file, error.boxes, again)));
    }
    return;
  } finally {
    $("start").inert = false;
    busy("");
  }
  controls.load(avatar.source);
  meter.clear();
  renders.dropped = 0;
  tally(0);
  show();
  announce("The portrait is ready.");
  if (focused) $("controls").focus({ preventScroll: true });
  changed();
}

function show() {
  const ready = avatar !== null;
  $("start").hidden = ready;
  $("frame").classList.toggle("filled", ready);
  $("control-set").disabled = !ready;
  for (const id of ["mark", "toolbar", "stats"]) $(id).hidden = !ready;
  $("by-sliders").setAttribute("aria-pressed", String(!streaming));
  $("by-camera").setAttribute("aria-pressed", String(streaming));
  $("camera-view").hidden = !streaming;
  $("camera-card").hidden = !streaming;
  $("slider-panel").hidden = streaming;
  $("server-time").hidden = streaming; // HTTP answers say it, frames of a stream do not
  $("colour-field").hidden = $("background").value !== "colour";
  $("mode-hint").textContent = streaming ? "" : MODE_HINTS[$("mode").value];
  $("reference").hidden = $("mode").value !== "relative";
  if (ready) describe();
}

/** An error, and back to the start when the avatar is no longer there. */
function failed(error) {
  if (GONE.has(error.code) || GONE.has(error.status)) leave();
  complain(error);
}

function leave() {
  stopCamera();
  renders.cancel();
  picture.clear();
  avatar = null;
  $("consent").checked = false;
  busy("");
  show();
  $("file").focus({ preventScroll: true });
}

$("change").addEventListener("click", () => { quiet(); leave(); });

$("delete").addEventListener("click", async () => {
  quiet();
  try {
    await api.delete(avatar.id);
  } catch (error) {
    failed(error);
    if (avatar) return;
  }
  leave();
  announce("The avatar is deleted.");
});

// Sliders ----------------------------------------------------------------------------------

function currentRequest() {
  return { ...controls.request(), output: output() };
}

function changed() {
  if (!avatar) return;
  describe();
  if (!streaming) renders.ask({ avatar: avatar.id, request: currentRequest() });
}

async function render({ avatar: id, request }) {
  const start = performance.now();
  let answer;
  try {
    answer = await api.render(id, request);
    if (avatar?.id !== id || streaming) return;
    await picture.show(answer.blob, ALT);
  } catch (error) {
    if (avatar?.id === id) failed(error);
    // Room for others: a busy server says how long to wait.
    if (error.retryAfter) await sleep(Math.min(error.retryAfter, 5) * 1000);
    return;
  }
  quiet();
  meter.add(performance.now() - start, answer.milliseconds);
  tally(renders.dropped);
}

for (const [name, weights] of Object.entries(PRESETS)) {
  const button = element("button", { type: "button" }, name);
  button.addEventListener("click", () => controls.preset(weights));
  $("presets").append(button);
}
$("mirror").addEventListener("change", () => { controls.mirror = $("mirror").checked; });
$("reset").addEventListener("click", () => { controls.reset(); changed(); });
$("controls").addEventListener("submit", (event) => event.preventDefault());
for (const id of ["background", "colour", "size", "mode", "follow"]) {
  $(id).addEventListener("input", () => {
    controls.setMode($("mode").value);
    show();
    changed();
    // A stream's terms are set by its hello.
    if (streaming) startCamera();
  });
}

// Webcam -----------------------------------------------------------------------------------

$("by-camera").addEventListener("click", () => { if (!streaming) startCamera(); });
$("by-sliders").addEventListener("click", () => {
  if (!streaming) return;
  stopCamera();
  quiet();
  changed();
});
$("reference").addEventListener("click", () => {
  stream.setReference();
  announce("This face counts as neutral now.");
});

function startCamera() {
  streaming = true;
  renders.cancel();
  show();
  starts.ask(hello());
}

async function openStream(terms) {
  stream.stop();
  quiet();
  busy("Starting the webcam …");
  meter.clear();
  lostFaces = 0;
  tally(0);
  try {
    const ticket = api.key ? await api.ticket() : null;
    if (streaming) await stream.start({ avatar: avatar.id, ticket, hello: terms });
  } catch (error) {
    if (streaming) {
      stopCamera();
      failed(error);
    }
    return;
  }
  if (!streaming) stream.stop();
  busy("");
}

function stopCamera() {
  stream.stop();
  starts.cancel();
  if (!streaming) return;
  streaming = false;
  meter.clear();
  busy("");
  show();
}

async function streamed(blob, latency) {
  await picture.show(blob, "AI-generated picture of the portrait, moved by your webcam");
  meter.add(latency());
  busy("");
}

function counted(counts) {
  tally(counts.dropped);
  if (counts.lost_face > lostFaces) busy("No face in sight: the last picture stays");
  lostFaces = counts.lost_face;
}

// Figures, request, download ---------------------------------------------------------------

function tally(dropped) {
  $("stat-dropped").textContent = String(dropped);
}

function describe() {
  const keyed = api.key !== "";
  const [json, curl] = streaming
    ? [hello(), driveLine(avatar.id, hello(), keyed)]
    : [currentRequest(), renderLine(avatar.id, currentRequest(), keyed)];
  $("json").textContent = pretty(json);
  $("curl").textContent = curl;
}

$("download").addEventListener("click", async () => {
  const blob = await picture.png(sourceType);
  if (!blob) return;
  const address = URL.createObjectURL(blob);
  element("a", { href: address, download: "cvthead.png" }).click();
  await sleep(10_000);
  URL.revokeObjectURL(address);
});

$("alert-close").addEventListener("click", quiet);
keepFigures(meter);
copyButtons();
askForKey((key) => {
  api.key = key;
  if (avatar) describe();
});
window.addEventListener("pagehide", () => stream.stop());
show();
