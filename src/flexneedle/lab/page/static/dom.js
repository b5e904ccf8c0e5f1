// Create elements without markup in strings.

// An element: name with classes ("div.stage"), properties and attributes, children (elements or text).
// A function is a listener of the event by that name ({click: …}); undefined and false are left out.
export function make(name, properties = {}, ...children) {
  const [tag, ...classes] = name.split(".");
  const element = document.createElement(tag);
  element.classList.add(...classes);
  for (const [key, value] of Object.entries(properties)) {
    if (value === undefined || value === false) continue;
    if (typeof value === "function") element.addEventListener(key, value);
    else if (key in element && typeof value !== "string") element[key] = value;
    else element.setAttribute(key, value === true ? "" : value);
  }
  element.append(...children);
  return element;
}

export const button = (text, click, properties = {}) => make("button", { type: "button", click, ...properties }, text);

// Replace the children of an element where their text differs: a screen reader announces what is replaced.
export function renew(element, children) {
  if (children.map(({ textContent }) => textContent).join("") !== element.textContent) element.replaceChildren(...children);
}

// Make elements the children of an element. Those that are its children already stay in place where their order allows
// it, and keep the focus.
export function arrange(element, children) {
  for (const child of [...element.children]) if (!children.includes(child)) child.remove();
  children.forEach((child, at) => {
    if (element.children[at] !== child) element.insertBefore(child, element.children[at] ?? null);
  });
}

// Format a number with three significant digits, as the command line does; "–" if it is unknown.
export const brief = (value) => (Number.isFinite(value) ? String(Number(value.toPrecision(3))).replace("-", "−") : "–");

// Format a number: digits after the point, with a true minus sign; "–" if it is unknown.
export function shown(value, digits = 2) {
  if (value === null || value === undefined || Number.isNaN(value)) return "–";
  return value.toFixed(digits).replace(/^-(?=[0.]*$)/, "").replace("-", "−");
}
