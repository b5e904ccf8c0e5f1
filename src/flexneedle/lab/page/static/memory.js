// Storage of this browser. It may refuse, above all for a page from a file; then nothing is stored.

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
