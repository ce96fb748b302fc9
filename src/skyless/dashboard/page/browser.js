/** What this browser remembers of the page; a private window remembers nothing, and that is no fault. */

/** @returns {string|null} */
export function remembered(key) {
  try {
    return localStorage.getItem(key);
  } catch {
    return null;
  }
}

/** Remember a choice. */
export function remember(key, value) {
  try {
    localStorage.setItem(key, value);
  } catch {
    // the choice lasts as long as the page
  }
}
