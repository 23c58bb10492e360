// The sliders: builds them, keeps their values, and says what to ask of the service.

import { element } from "./dom.js";
import { toAxisAngle, toDegrees } from "./rotation.js";
import { GROUPS, partner } from "./sliders.js";

const SHAPE_SIZE = 100;
const ROTATED = { global: ["global"], neck: ["neck"], jaw: ["jaw"], gaze: ["left_eye", "right_eye"] };
const AXES = ["pitch", "yaw", "roll"];

const rounded = (value) => Math.round(value * 1e5) / 1e5;

export class Controls {
  /** Builds the groups inside `root`; `changed()` is called after every move. */
  constructor(root, changed) {
    this.changed = changed;
    this.mirror = true;
    this.mode = "relative";
    this.source = null;
    this.sliders = new Map();
    this.groups = GROUPS.map((group) => this.#group(root, group));
  }

  /** Start again from a portrait (AvatarInfo.source). */
  load(source) {
    this.source = source;
    this.reset();
  }

  /** Put every slider where it changes nothing. */
  reset() {
    for (const slider of this.sliders.values()) this.#put(slider, this.#rest(slider.id));
    this.#count();
  }

  /** Reset the ARKit sliders and put the named ones at the given weights. */
  preset(weights) {
    for (const slider of this.sliders.values()) {
      const [kind, name] = slider.id.split(".");
      if (kind === "arkit") this.#put(slider, weights[name] ?? 0);
    }
    this.#count();
    this.changed();
  }

  /** Change between "relative" and "absolute" without moving the head. */
  setMode(mode) {
    if (mode === this.mode) return;
    const moved = [...this.sliders.values()].map((s) => [s, s.value - this.#rest(s.id)]);
    this.mode = mode;
    for (const [slider, by] of moved) this.#put(slider, this.#rest(slider.id) + by);
    this.#count();
  }

  /** Only what was moved: an absent field keeps the portrait's value. */
  request() {
    const request = { mode: this.mode };
    const arkit = {};
    for (const { id, value } of this.sliders.values()) {
      const [kind, name] = id.split(".");
      if (kind === "arkit" && value > 0) arkit[name] = value;
    }
    if (Object.keys(arkit).length) request.arkit = arkit;
    const pose = {};
    for (const [kind, joints] of Object.entries(ROTATED)) {
      const rotation = this.#rotation(kind);
      if (rotation) for (const joint of joints) pose[joint] = rotation.map(rounded);
    }
    if (Object.keys(pose).length) request.pose = pose;
    const shape = this.#shape();
    if (shape) request.shape = shape.map(rounded);
    return request;
  }

  #rotation(kind) {
    const parts = AXES.map((axis) => this.sliders.get(`${kind}.${axis}`));
    if (!parts.some((slider) => slider && this.#moved(slider))) return null;
    // A joint without this slider (the jaw's roll) keeps the portrait's angle.
    return toAxisAngle(AXES.map((axis, i) => parts[i]?.value ?? this.#rest(`${kind}.${axis}`)));
  }

  #shape() {
    const own = [...this.sliders.values()].filter((slider) => slider.id.startsWith("shape."));
    if (!own.some((slider) => this.#moved(slider))) return null;
    const shape = this.mode === "absolute" ? [...this.source.shape] : Array(SHAPE_SIZE).fill(0);
    for (const slider of own) shape[Number(slider.id.split(".")[1])] = slider.value;
    return shape;
  }

  /** The value at which a slider changes nothing. */
  #rest(id) {
    if (this.mode === "relative" || !this.source) return 0;
    const [kind, name] = id.split(".");
    if (kind === "shape") return this.source.shape[Number(name)];
    const joints = ROTATED[kind];
    if (!joints) return 0;
    const sum = joints.map((joint) => toDegrees(this.source.pose[joint])[AXES.indexOf(name)]);
    return sum.reduce((a, b) => a + b, 0) / joints.length;
  }

  #moved(slider) {
    return Math.abs(slider.value - this.#rest(slider.id)) > slider.step / 2;
  }

  #put(slider, value) {
    slider.value = value;
    slider.input.min = Math.min(slider.min, Math.floor(value));
    slider.input.max = Math.max(slider.max, Math.ceil(value));
    slider.input.value = value;
    this.#show(slider);
  }

  #show(slider) {
    const digits = slider.step < 0.1 ? 2 : 1;
    const text = `${slider.value.toFixed(digits)}${slider.unit}`.replace(/^-(?=0\.0*\D*$)/, "");
    slider.output.textContent = text;
    slider.input.setAttribute("aria-valuetext", text);
    slider.row.classList.toggle("moved", this.#moved(slider));
  }

  #count() {
    for (const { count, ids } of this.groups) {
      const moved = ids.filter((id) => this.#moved(this.sliders.get(id))).length;
      count.textContent = moved ? `${moved} moved` : "";
    }
  }

  #slide(slider) {
    slider.value = slider.input.valueAsNumber;
    this.#show(slider);
    const other = this.mirror && this.sliders.get(partner(slider.id));
    if (other) this.#put(other, slider.value);
    this.#count();
    this.changed();
  }

  #group(root, { title, hint, open = false, sliders }) {
    const box = element("details", { className: "card", open });
    const count = element("span", { className: "count" });
    const body = element("div", { className: "sliders", role: "group", ariaLabel: title });
    box.append(element("summary", {}, title, count), body);
    if (hint) body.append(element("p", { className: "hint" }, hint));
    for (const definition of sliders) body.append(this.#slider(definition));
    root.append(box);
    return { count, ids: sliders.map((slider) => slider.id) };
  }

  #slider(definition) {
    const id = `slider-${definition.id.replace(".", "-")}`;
    const { min, max, step, hint, title = "" } = definition;
    const label = element("label", { htmlFor: id, title }, definition.label);
    const name = element("div", { className: "name" }, label);
    const input = element("input", { id, type: "range", min, max, step, value: 0 });
    if (hint) {
      name.append(element("small", { id: `${id}-hint` }, hint));
      input.setAttribute("aria-describedby", `${id}-hint`);
    }
    const output = element("output", { htmlFor: id });
    const row = element("div", { className: "slider" }, name, input, output);
    const slider = { ...definition, value: 0, input, output, row };
    this.sliders.set(slider.id, slider);
    input.addEventListener("input", () => this.#slide(slider));
    row.addEventListener("dblclick", () => {
      this.#put(slider, this.#rest(slider.id));
      this.#count();
      this.changed();
    });
    this.#show(slider);
    return row;
  }
}
