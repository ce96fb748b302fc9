/** What the page asks the server, relative to where the page stands. */

/** Fetch JSON; throws an Error with the server's words. */
export async function fetchJson(path, options = {}) {
  let answer;
  try {
    answer = await fetch(new URL(path, document.baseURI), { cache: "no-store", ...options });
  } catch {
    throw new Error("The server does not answer.");
  }
  let body = null;
  try {
    body = await answer.json();
  } catch {
    // an error page of somebody in between
  }
  if (!answer.ok) throw new Error(body?.error ?? `The server answers ${answer.status} ${answer.statusText}.`);
  if (body === null) throw new Error("The server's answer is no JSON.");
  return body;
}

/** Store all zones; returns them as the server has them now. */
export async function putZones(zones) {
  const body = JSON.stringify({ zones });
  const answer = await fetchJson("api/zones", { method: "PUT", headers: { "content-type": "application/json" }, body });
  return Array.isArray(answer) ? answer : answer.zones;
}

/** The values of an overlay on a grid. */
export function overlay(kind, step_m) {
  return fetchJson(`api/overlay?kind=${encodeURIComponent(kind)}&step_m=${step_m}`);
}

/** All recordings, the newest first. */
export function recordings() {
  return fetchJson("api/recordings");
}

/** What a recording holds. */
export function recording(name) {
  return fetchJson(`api/recordings/${encodeURIComponent(name)}`);
}

/** States of a recording between two times since its start, at most 60 s. */
export async function recordedStates(name, from_s, to_s, rate_hz) {
  const query = `from_s=${from_s.toFixed(3)}&to_s=${to_s.toFixed(3)}&rate_hz=${rate_hz}`;
  return (await fetchJson(`api/recordings/${encodeURIComponent(name)}/states?${query}`)).states;
}
