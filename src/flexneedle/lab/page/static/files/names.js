// A name as requests may have it (messages.py: Name).
export const safe = (name) => name.replace(/[^A-Za-z0-9 ._-]/g, "_").replace(/^[^A-Za-z0-9]+/, "").slice(0, 80) || "scenario";
