// Small helpers around the document.

export const $ = (id) => document.getElementById(id);

/** An element with properties and children; text stays text. */
export function element(tag, properties, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (name === "htmlFor") made.setAttribute("for", value);
    else made[name] = value;
  }
  made.append(...children);
  return made;
}

export function sleep(milliseconds) {
  return new Promise((resolve) => { setTimeout(resolve, milliseconds); });
}
