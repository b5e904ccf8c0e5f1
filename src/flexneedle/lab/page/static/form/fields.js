// Fields of a scenario, from its JSON schema: name, unit, bounds and description of each value. No elements here.

// By the end of a key, the longest first.
const UNITS = Object.entries({
  _mrad_per_mm: "mrad/mm", _mrad_s: "mrad/s", _mn_per_mm: "mN/mm", _deg_s: "°/s", _mm_s: "mm/s", _per_mm: "/mm", _per_mj: "/mJ", _per_m: "1/m",
  _kpa: "kPa", _gpa: "GPa", _mrad: "mrad", _percent: "%", _deg: "°", _hz: "Hz", _mm: "mm", _mn: "mN", _n: "N", _s: "s",
});
const TECHNICAL = 1e5; // a larger bound is not shown
const FAR = 20; // a slider ignores a bound this many times the usual value
const STEPS = 200; // of a slider
const OWN = "own values"; // of a table without a name
const LAW = "Law of radial compression. A custom law is set in a scenario file.";
const TERMS = "terms"; // custom cost terms are set in a scenario file
const OWN_TYPES = { number: "number", string: "string", boolean: "boolean" }; // by type of the value

// Sections with their fields: [{name, title, description, fields}]; a layer of the tissue, a zone and a table is a section.
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
    else if (key === "zone") addZones(sections, schema, values);
    else if (part !== TERMS) addValue(sections, section, schema, key, property, values);
  }
}

function addValue(sections, section, schema, key, property, values) {
  const table = tableOf(schema, property);
  if (!table || isNullable(property)) section.fields.push(table ? choiceOf(key, property, table) : fieldOf(key, property));
  if (table && (!isNullable(property) || isUsed(values, key))) addSection(sections, schema, key, table, values);
}

// The field of a table that may be left out: not set, one of its names, or one to begin with (start).
function choiceOf(key, property, table) {
  const field = fieldOf(key, property);
  return { ...field, kind: "choice", choices: [...(field.choices ?? []), OWN], start: startOf(table) };
}

// Values to begin a table with: an example of each that has no default, or what it had `before`.
function startOf({ properties, required = [] }, before = {}) {
  const kept = Object.entries(before).filter(([name]) => name in properties);
  return { ...Object.fromEntries(required.map((name) => [name, properties[name].const ?? properties[name].examples?.[0]])), ...Object.fromEntries(kept) };
}

function addLayers(sections, schema, property, values) {
  for (let layer = 0; `tissue.${layer}.shear_modulus_kpa` in values; layer++) {
    const [name, laws] = [`tissue.${layer}`, lawsOf(schema)];
    const law = values[`${name}.law`];
    const table = laws[law] ?? ownLaw(Object.values(laws), name, values);
    const choices = law in laws ? Object.keys(laws) : [law];
    const properties = { ...table.properties, law: { enum: choices, description: LAW } };
    addSection(sections, schema, name, { ...table, properties }, values);
  }
}

// A zone has the fields of its shape, which stays.
function addZones(sections, schema, values) {
  const tables = schema.properties.zone.items.anyOf.map((each) => resolved(schema, each));
  for (let zone = 0; `zone.${zone}.shape` in values; zone++) {
    const table = tables.find(({ properties }) => properties.shape.const === values[`zone.${zone}.shape`]);
    const { shape: _, ...properties } = table.properties;
    addSection(sections, schema, `zone.${zone}`, { properties, description: "" }, values);
  }
}

// The table of a layer with a custom law: the keys of all laws, and its other values.
function ownLaw([table, ...others], name, values) {
  const common = Object.entries(table.properties).filter(([part]) => others.every(({ properties }) => part in properties));
  const parts = Object.keys(values).filter((key) => key.startsWith(`${name}.`)).map((key) => key.slice(name.length + 1));
  const own = parts.map((part) => [part, { type: OWN_TYPES[typeof values[`${name}.${part}`]] ?? "array" }]);
  return { description: "A layer with a custom law.", properties: { ...Object.fromEntries(own), ...Object.fromEntries(common) } };
}

// A layer with another law: it keeps the values that both have.
export function withLaw(schema, layer, law) {
  const { law: _, ...before } = layer;
  return { ...startOf(lawsOf(schema)[law], before), law };
}

// Tables of the layers by law.
function lawsOf(schema) {
  const tables = schema.properties.tissue.items.anyOf.map((each) => resolved(schema, each));
  return Object.fromEntries(tables.map((table) => [table.properties.law.const, table]));
}

// Value of a field from the values by key: for a table its name, or "own values".
export function valueOf({ key, start, choices }, values) {
  if (!start) return values[key] ?? null;
  if (!isUsed(values, key)) return null;
  const name = values[`${key}.name`];
  return choices.includes(name) ? name : OWN;
}

// The edit {key: value} for a field's shown value; a table with own values keeps them, or begins with examples.
export function editOf({ key, start }, value, values) {
  if (!start || value !== OWN) return { [key]: value };
  return isUsed(values, key) ? { [`${key}.name`]: start.name } : { [key]: start };
}

// Shown value of an edited value.
export const shownOf = ({ start }, value) => (start && typeof value === "object" && value ? OWN : value);

const isUsed = (values, key) => Object.keys(values).some((each) => each.startsWith(`${key}.`));

// {key, label, unit, kind, nullable, min, max, choices, description, usual}; kind: number, integer, switch, choice,
// list (of numbers), points (a list of them) or text.
function fieldOf(key, property) {
  const all = [property, ...(property.anyOf ?? [])];
  const found = (name) => all.find((each) => each[name] !== undefined)?.[name];
  const choices = found("enum");
  const type = all.map((each) => each.type).find((each) => each && each !== "null");
  const kinds = { number: "number", integer: "integer", boolean: "switch", array: found("items")?.type === "array" ? "points" : "list" };
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

// Bounds in words, without technical ones.
function inWords([min, max]) {
  const given = max < TECHNICAL;
  if (min === undefined && !given) return "";
  if (!given) return min === 0 ? "" : ` At least ${min}.`;
  return min === undefined ? ` At most ${max}.` : ` From ${min} to ${max}.`;
}

// Range of a slider about a value: {min, max, step}, within the bounds, or null without bounds.
export function rangeOf({ kind, min, max, open, usual }, value) {
  if (kind !== "number" && kind !== "integer") return null;
  const size = Math.max(Math.abs(value ?? 0), Math.abs(usual ?? 0)) || 5;
  const high = max === undefined || max > FAR * size ? nice(2 * size) : max;
  const low = min === undefined || min < -FAR * size ? -high : min;
  const step = kind === "integer" ? 1 : nice((high - low) / STEPS);
  return { min: open ? low + step : low, max: high, step };
}

// Parse the user's text: {value} or {problem}.
export function read({ kind, nullable }, text) {
  const words = text.trim();
  if (kind === "text" || kind === "choice") return { value: words === "" && nullable ? null : words };
  if (words === "") return nullable ? { value: null } : { problem: "must be a number" };
  if (kind === "points") {
    const points = words.replace(/;\s*$/, "").split(";").map((point) => read({ kind: "list" }, point));
    const isPoint = ({ value }) => value?.length === 3;
    return points.every(isPoint) ? { value: points.map(({ value }) => value) } : { problem: "must be points x, y, z, separated by semicolons" };
  }
  const parts = words.replaceAll("−", "-").split(kind === "list" ? /\s*[,;]\s*|\s+/ : /$^/);
  const numbers = parts.map((part) => (part.trim() === "" ? NaN : Number(part))); // an empty one would be 0
  if (numbers.some((number) => !Number.isFinite(number))) {
    return { problem: kind === "list" ? "must be numbers, separated by commas" : "must be a number" };
  }
  if (kind === "integer" && !Number.isInteger(numbers[0])) return { problem: "must be a whole number" };
  return { value: kind === "list" ? numbers : numbers[0] };
}

// A value as a user would write it.
export function written(value) {
  if (value === null || value === undefined) return "";
  if (!Array.isArray(value)) return String(value);
  return Array.isArray(value[0]) ? value.map(written).join("; ") : value.join(", ");
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
  const [, zone] = /^zone\.(\d+)$/.exec(name) ?? [];
  if (zone) return `Zone ${Number(zone) + 1}: ${values[`${name}.name`]}, ${values[`${name}.shape`]}`;
  const words = name.replaceAll("_", "-").split(".").join(", ");
  return words ? words[0].toUpperCase() + words.slice(1) : "General";
}

function firstSentence(text) {
  const words = (text ?? "").replace(/^Section `[^`]*`[.:]? ?/, "").replaceAll("`", "").split("\n")[0];
  return words && words[0].toUpperCase() + words.slice(1);
}

const resolved = (schema, property) => (property.$ref ? schema.$defs[property.$ref.split("/").at(-1)] : property);
const isNullable = ({ anyOf }) => Boolean(anyOf?.some(({ type }) => type === "null"));

// The table that a property is or may be, or null.
function tableOf(schema, property) {
  const tables = [property, ...(property.anyOf ?? [])].filter(({ $ref }) => $ref).map((each) => resolved(schema, each));
  return tables.find(({ type }) => type === "object") ?? null;
}
