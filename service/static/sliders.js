// What can be moved: every slider's name, range and place on the page.

const TURNS = [
  ["pitch", "Nod", "− up, + down"],
  ["yaw", "Turn", "− left, + right"],
  ["roll", "Tilt", "− right, + left"],
];

function turns(joint, limit) {
  return TURNS.map(([axis, label, hint]) => ({
    id: `${joint}.${axis}`, label, hint, min: -limit, max: limit, step: 0.5, unit: "°",
  }));
}

function degrees(id, label, hint, min, max) {
  return { id, label, hint, min, max, step: 0.5, unit: "°" };
}

/** "mouthSmileLeft" -> "Smile left"; the group's heading says the rest. */
function readable(name) {
  const words = name.replace(/^(brow|eye|jaw|mouth|cheek)(?=[A-Z])/, "");
  const text = words.replace(/([a-z])([A-Z])/g, "$1 $2").toLowerCase();
  return text[0].toUpperCase() + text.slice(1);
}

function units(names) {
  return names.map((name) => ({
    id: `arkit.${name}`, label: readable(name), title: name, min: 0, max: 1, step: 0.01, unit: "",
  }));
}

function sides(...names) {
  return names.flatMap((name) => [`${name}Left`, `${name}Right`]);
}

export const GROUPS = [
  { title: "Head", open: true, sliders: turns("global", 60) },
  {
    title: "Brows",
    sliders: units(["browInnerUp", ...sides("browDown", "browOuterUp")]),
  },
  {
    title: "Eyes",
    sliders: units(sides("eyeBlink", "eyeSquint", "eyeWide", "eyeLookUp", "eyeLookDown",
      "eyeLookIn", "eyeLookOut")),
  },
  { title: "Jaw", sliders: units(["jawOpen", "jawForward", "jawLeft", "jawRight"]) },
  {
    title: "Mouth",
    sliders: units([
      ...sides("mouthSmile", "mouthFrown", "mouthDimple", "mouthStretch", "mouthUpperUp",
        "mouthLowerDown", "mouthPress"),
      "mouthPucker", "mouthFunnel", "mouthClose", "mouthLeft", "mouthRight",
      "mouthRollUpper", "mouthRollLower", "mouthShrugUpper", "mouthShrugLower", "tongueOut",
    ]),
  },
  {
    title: "Cheeks and nose",
    sliders: units(["cheekPuff", ...sides("cheekSquint", "noseSneer")]),
  },
  {
    title: "Gaze",
    hint: "Both eyes together. Goes before the look sliders of the eyes.",
    sliders: [
      degrees("gaze.pitch", "Up and down", "− up, + down", -25, 25),
      degrees("gaze.yaw", "Sideways", "− left, + right", -35, 35),
    ],
  },
  { title: "Neck", sliders: turns("neck", 30) },
  {
    title: "Jaw joint",
    hint: "The joint itself. Goes before the jaw sliders above.",
    sliders: [
      degrees("jaw.pitch", "Open", "", -5, 30),
      degrees("jaw.yaw", "Sideways", "− left, + right", -12, 12),
    ],
  },
  {
    title: "Head shape",
    hint: "The ten strongest directions of identity, in standard deviations.",
    sliders: Array.from({ length: 10 }, (_, index) => ({
      id: `shape.${index}`, label: `Shape ${index + 1}`, min: -3, max: 3, step: 0.05, unit: "σ",
    })),
  },
];

export const PRESETS = {
  Smile: { mouthSmileLeft: 0.8, mouthSmileRight: 0.8, cheekSquintLeft: 0.4, cheekSquintRight: 0.4 },
  Surprise: {
    browInnerUp: 0.9, browOuterUpLeft: 0.7, browOuterUpRight: 0.7, eyeWideLeft: 0.8,
    eyeWideRight: 0.8, jawOpen: 0.45,
  },
  Wink: { eyeBlinkLeft: 1, mouthSmileLeft: 0.5, cheekSquintLeft: 0.6 },
  Frown: { browDownLeft: 0.9, browDownRight: 0.9, mouthFrownLeft: 0.7, mouthFrownRight: 0.7 },
};

/** The slider that moves along when left and right go together, or undefined. */
export function partner(id) {
  // "jawLeft" and "mouthLeft" are directions, and equal looks inward would cross the eyes.
  if (/^arkit\.(jaw|mouth)(Left|Right)$|LookIn|LookOut/.test(id)) return undefined;
  if (id.endsWith("Left")) return id.replace(/Left$/, "Right");
  if (id.endsWith("Right")) return id.replace(/Right$/, "Left");
  return undefined;
}
