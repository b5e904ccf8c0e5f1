// A name that requests accept (requests.py: FileName).
export const safe = (name) => name.replace(/[^A-Za-z0-9 ._-]/g, "_").replace(/^[^A-Za-z0-9]+/, "").slice(0, 80) || "scenario";
