/** Requests to the server, relative to the page's own address. */

import { state } from "./store.js";

/** The query of what belongs to the live site: it names the one that the page shows, whichever others there are. */
function ofSite(query = "") {
  const named = state.liveId === null ? query : `site=${state.liveId}&${query}`;
  return named && `?${named}`;
}

/** Fetch JSON; throws an Error with the server's message. */
async function fetchJson(path, options = {}) {
  let answer;
  try {
    answer = await fetch(new URL(path, document.baseURI), { cache: "no-store", ...options });
  } catch {
    throw new Error("The server does not respond.");
  }
  let body = null;
  try {
    body = await answer.json();
  } catch {
    // an error page of a proxy
  }
  if (!answer.ok) throw new Error(body?.error ?? `The server responds with ${answer.status} ${answer.statusText}.`);
  if (body === null) throw new Error("The server's response is not JSON.");
  return body;
}

/** Store all zones of the site of a name; returns them as the server has stored them. */
export async function putZones(zones, site) {
  const body = JSON.stringify({ zones, site });
  const headers = { "content-type": "application/json" };
  return (await fetchJson(`api/zones${ofSite()}`, { method: "PUT", headers, body })).zones;
}

/** Give the survey program all that the user knows; throws an Error that names the field that is wrong. */
export function putFacts(facts, floor_plan) {
  const body = JSON.stringify({ facts, floor_plan });
  const headers = { "content-type": "application/json" };
  return fetchJson(`api/survey/facts${ofSite()}`, { method: "PUT", headers, body });
}

/** Have the survey program save the result of a number. */
export function saveSurvey(serial) {
  const body = JSON.stringify({ serial });
  const headers = { "content-type": "application/json" };
  return fetchJson(`api/survey/save${ofSite()}`, { method: "POST", headers, body });
}

/** Store the image of the floor, a PNG or JPEG. @param {Blob} image */
export function putFloorPlan(image) {
  return fetchJson(`api/floor_plan${ofSite()}`, { method: "PUT", headers: { "content-type": image.type }, body: image });
}

/** The values of an overlay on a grid. */
export function overlay(kind, step_m) {
  return fetchJson(`api/overlay${ofSite(`kind=${encodeURIComponent(kind)}&step_m=${step_m}`)}`);
}

/** All recordings, newest first. */
export function recordings() {
  return fetchJson("api/recordings");
}

/** Site, times, tags and zones of a recording. */
export function recording(name) {
  return fetchJson(`api/recordings/${encodeURIComponent(name)}`);
}

/** What has happened in a recording: events, the oldest first, and whether these are all. */
export function recordedEvents(name) {
  return fetchJson(`api/recordings/${encodeURIComponent(name)}/events`);
}

/** Address of a recording's file. */
export function fileOf(name) {
  return new URL(`api/recordings/${encodeURIComponent(name)}/file`, document.baseURI).href;
}

/** Address of the floor plan's image: of a recording, or with null of the live site, whose digest differs by image. */
export function floorPlanOf(name, digest) {
  const path = name === null ? `api/floor_plan${ofSite(`digest=${digest}`)}` : `api/recordings/${encodeURIComponent(name)}/floor_plan`;
  return new URL(path, document.baseURI).href;
}

/** States of a recording between two times since its start, at most 60 s. */
export async function recordedStates(name, from_s, to_s, rate_hz) {
  const query = `from_s=${from_s.toFixed(3)}&to_s=${to_s.toFixed(3)}&rate_hz=${rate_hz}`;
  return (await fetchJson(`api/recordings/${encodeURIComponent(name)}/states?${query}`)).states;
}

/** An answer of the history; `kind` is the end of its address. @param {AbortSignal} signal */
export function history(kind, query, signal) {
  return fetchJson(`api/v1/history/${kind}${ofSite(String(new URLSearchParams(query)))}`, { signal });
}

/** The packets of one tag from a time on, for the page to recompute them. */
export function whatIf(name, tag, from_s, seconds) {
  const query = `tag=${encodeURIComponent(tag)}&from_s=${from_s.toFixed(3)}&seconds=${seconds}`;
  return fetchJson(`api/recordings/${encodeURIComponent(name)}/what_if?${query}`);
}
