// Light or dark: as the system prefers, or as chosen by the switch, which this browser stores.

const CHOICE = "flexneedle theme";
const [SOFT, STIFF] = [1, 30]; // kPa, layers of the faintest and the strongest colour
const colors = new Map(); // by name, in the present theme
const system = matchMedia("(prefers-color-scheme: dark)");
let choice = remembered(CHOICE);

// Keep store key "view theme" ("light", "dark") and the attribute data-theme of the document; `button` switches.
export function followTheme(store, button) {
  const apply = () => {
    const theme = choice ?? (system.matches ? "dark" : "light");
    document.documentElement.dataset.theme = theme;
    colors.clear();
    button.textContent = theme === "dark" ? "Light" : "Dark";
    button.setAttribute("aria-label", `Switch to ${theme === "dark" ? "light" : "dark"} colours`);
    store.set("view theme", theme);
  };
  button.addEventListener("click", () => {
    choice = store.get("view theme") === "dark" ? "light" : "dark";
    remember(CHOICE, choice);
    apply();
  });
  system.addEventListener("change", apply);
  apply();
}

// Colour of style.css by name, such as "--needle", as "rgb(…)", for canvases and WebGL. Ask again when "view theme"
// changes.
export function color(name) {
  if (!colors.has(name)) colors.set(name, computed(name));
  return colors.get(name);
}

function computed(name) {
  const probe = document.getElementById("theme");
  probe.style.outlineColor = `var(${name})`;
  const found = getComputedStyle(probe).outlineColor;
  probe.style.outlineColor = "";
  return found;
}

// The storage of this browser may refuse, above all for a page from a file; then nothing is stored.
function remembered(key) {
  try {
    return localStorage.getItem(key);
  } catch {
    return null;
  }
}

function remember(key, text) {
  try {
    localStorage.setItem(key, text);
  } catch {
    // as above
  }
}

// Strength of a layer's colour, from 0 for a soft layer to 1 for a stiff one, by the logarithm of its shear modulus (kPa).
export const shadeOf = (modulus) => Math.log(Math.min(Math.max(modulus, SOFT), STIFF) / SOFT) / Math.log(STIFF / SOFT);
