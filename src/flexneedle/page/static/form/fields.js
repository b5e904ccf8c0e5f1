// Fields of a scenario, from its JSON schema: what each value is, its unit, bounds and words. No elements here.

// By the end of a key, the longest first.
const UNITS = Object.entries({
  _mrad_s: "mrad/s", _mn_per_mm: "mN/mm", _deg_s: "°/s", _mm_s: "mm/s", _per_mm: "/mm", _per_mj: "/mJ", _per_m: "1/m",
  _kpa: "kPa", _gpa: "GPa", _mrad: "mrad", _percent: "%", _deg: "°", _hz: "Hz", _mm: "mm", _mn: "mN", _n: "N", _s: "s",
});
const TECHNICAL = 1e5; // a bound from here on only keeps out nonsense
const FAR = 20; // a bound this many times the usual value is none for a slider
const STEPS = 200; // of a slider

// Sections with their fields: [{name, title, description, fields}]; a layer of the tissue and a table is a section.
export function sectionsOf(schema, values) {
  const sections = [];
  addSection(sections, schema, "", { ...schema, title: "General", description: "" }, values);
  return sections.filter(({ fields }) => fields.length);
}

function addSection(sections, schema, name, table, values) {
  const section = { name, title: titleOf(name, values), description: firstSentence(table.description), fields: [] };
  sections.push(section);
  for (const [part, property] of Object.entries(table.properties ?? {})) {
    const key = name ? `${name}.${part}` : part;
    if (key === "tissue") addLayers(sections, schema, property, values);
    else addValue(sections, section, schema, key, property, values);
  }
}

function addValue(sections, section, schema, key, property, values) {
  const table = tableOf(schema, property);
  const used = table && (!isNullable(property) || Object.keys(values).some((each) => each.startsWith(`${key}.`)));
  if (used) addSection(sections, schema, key, table, values);
  else if (!table || takesText(property)) section.fields.push(fieldOf(key, property));
}

function addLayers(sections, schema, property, values) {
  for (let layer = 0; `tissue.${layer}.shear_modulus_kpa` in values; layer++) {
    const law = values[`tissue.${layer}.law`] ?? "ogden";
    const laws = property.items.anyOf.map((each) => resolved(schema, each));
    const table = laws.find(({ properties }) => properties.law.const === law) ?? laws[0];
    const { law: _, ...properties } = table.properties;
    addSection(sections, schema, `tissue.${layer}`, { ...table, properties }, values);
  }
}

// {key, label, unit, kind, nullable, min, max, choices, description, usual}; kind: number, integer, switch, choice,
// list (of numbers) or text.
function fieldOf(key, property) {
  const all = [property, ...(property.anyOf ?? [])];
  const found = (name) => all.find((each) => each[name] !== undefined)?.[name];
  const choices = found("enum");
  const type = all.map((each) => each.type).find((each) => each && each !== "null");
  const kinds = { number: "number", integer: "integer", boolean: "switch", array: "list" };
  const bounds = [found("minimum") ?? found("exclusiveMinimum"), found("maximum") ?? found("exclusiveMaximum")];
  return {
    key,
    ...namesOf(key),
    kind: choices ? "choice" : kinds[type] ?? "text",
    nullable: isNullable(property),
    min: bounds[0],
    max: bounds[1],
    open: found("exclusiveMinimum") !== undefined,
    choices,
    description: `${(property.description ?? "").replaceAll("`", "").replaceAll("\n", " ")}${inWords(bounds)}`,
    usual: property.default ?? null,
  };
}

// Bounds that are not merely technical, for people.
function inWords([min, max]) {
  const given = max < TECHNICAL;
  if (min === undefined && !given) return "";
  if (!given) return min === 0 ? "" : ` At least ${min}.`;
  return min === undefined ? ` At most ${max}.` : ` From ${min} to ${max}.`;
}

// Range of a slider about a value: {min, max, step}, within the bounds, or null for what has none.
export function rangeOf({ kind, min, max, open, usual }, value) {
  if (kind !== "number" && kind !== "integer") return null;
  const size = Math.max(Math.abs(value ?? 0), Math.abs(usual ?? 0)) || 5;
  const high = max === undefined || max > FAR * size ? nice(2 * size) : max;
  const low = min === undefined || min < -FAR * size ? -high : min;
  const step = kind === "integer" ? 1 : nice((high - low) / STEPS);
  return { min: open ? low + step : low, max: high, step };
}

// What a user wrote, as a value of a field: {value} or {problem}.
export function read({ kind, nullable }, text) {
  const words = text.trim();
  if (kind === "text" || kind === "choice") return { value: words === "" && nullable ? null : words };
  if (words === "") return nullable ? { value: null } : { problem: "must be a number" };
  const numbers = words.replaceAll("−", "-").split(kind === "list" ? /[\s,;]+/ : /$^/).map(Number);
  if (numbers.some((number) => !Number.isFinite(number))) {
    return { problem: kind === "list" ? "must be numbers, separated by commas" : "must be a number" };
  }
  if (kind === "integer" && !Number.isInteger(numbers[0])) return { problem: "must be a whole number" };
  return { value: kind === "list" ? numbers : numbers[0] };
}

// A value as a user would write it.
export function written(value) {
  if (value === null || value === undefined) return "";
  return Array.isArray(value) ? value.join(", ") : String(value);
}

// 1, 2 or 5 times a power of ten, not below a number.
function nice(number) {
  const power = 10 ** Math.floor(Math.log10(number));
  return power * ([1, 2, 5].find((factor) => factor * power >= number * (1 - 1e-9)) ?? 10);
}

function namesOf(key) {
  const name = key.split(".").at(-1);
  const [ending, unit] = UNITS.find(([end]) => name.endsWith(end)) ?? ["", ""];
  const words = name.slice(0, name.length - ending.length).replaceAll("_", " ");
  return { label: words[0].toUpperCase() + words.slice(1), unit };
}

function titleOf(name, values) {
  const [, layer] = /^tissue\.(\d+)$/.exec(name) ?? [];
  if (layer) return `Layer ${Number(layer) + 1}: ${values[`${name}.name`] ?? "tissue"}`;
  const words = name.replaceAll("_", "-").split(".").join(", ");
  return words ? words[0].toUpperCase() + words.slice(1) : "General";
}

function firstSentence(text) {
  const words = (text ?? "").replace(/^Section `[^`]*`[.:]? ?/, "").replaceAll("`", "").split("\n")[0];
  return words && words[0].toUpperCase() + words.slice(1);
}

const resolved = (schema, property) => (property.$ref ? schema.$defs[property.$ref.split("/").at(-1)] : property);
const isNullable = ({ anyOf }) => Boolean(anyOf?.some(({ type }) => type === "null"));
const takesText = ({ anyOf }) => Boolean(anyOf?.some(({ type }) => type === "string"));

// The table that a property is or may be, or null.
function tableOf(schema, property) {
  const tables = [property, ...(property.anyOf ?? [])].filter(({ $ref }) => $ref).map((each) => resolved(schema, each));
  return tables.find(({ type }) => type === "object") ?? null;
}
