// What this browser remembers. It may refuse to, above all for a page from a file: then nothing outlasts the visit.

// A text by key, or null.
export function remembered(key) {
  try {
    return localStorage.getItem(key);
  } catch {
    return null;
  }
}

export function remember(key, text) {
  try {
    localStorage.setItem(key, text);
  } catch {
    // as above
  }
}
