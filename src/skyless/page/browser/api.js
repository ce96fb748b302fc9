/** Requests to the server, relative to the page's own address. */

import { state } from "./store.js";

/** The token is now in a cookie; remove it from the address and the history. */
export function dropToken() {
  const address = new URL(location.href);
  if (!address.searchParams.has("token")) return;
  address.searchParams.delete("token");
  window.history.replaceState(null, "", address);
}

/** The query of what belongs to the live site: it names the one that the page shows, whichever others there are. */
function ofSite(query = "") {
  const named = state.liveId === null ? query : `site=${state.liveId}&${query}`;
  return named && `?${named}`;
}

/** Fetch JSON, or what `read` makes of the answer; throws an Error with the server's message. */
export async function fetchJson(path, options = {}, read = (answer) => answer.json()) {
  let answer;
  try {
    answer = await fetch(new URL(path, document.baseURI), { cache: "no-store", ...options });
  } catch {
    throw new Error("The server does not respond.");
  }
  let body = null;
  try {
    body = await (answer.ok ? read(answer) : answer.json());
  } catch {
    // an error page of a proxy
  }
  if (!answer.ok) throw new Error(body?.error ?? `The server responds with ${answer.status} ${answer.statusText}.`);
  if (body === null) throw new Error("The server's response is not JSON.");
  return body;
}

/** Store all zones of the site of a name; returns them as the server has stored them. */
export async function putZones(zones, site) {
  return (await send("api/zones", { zones, site })).zones;
}

/** What the server keeps now for the live site: {assets} of "assets", or {rules} of "alarm_rules", those of the page. */
export function kept(what) {
  return fetchJson(`api/v1/${what}${ofSite()}`);
}

/** Store the same for the site of a name, all of it. */
export function keep(what, value, site) {
  return send(`api/v1/${what}`, { ...value, site });
}

/** Tell the server who has seen an alarm. */
export function acknowledge({ rule, subject, id }, by) {
  const path = `api/v1/alarms/${encodeURIComponent(rule)}/${encodeURIComponent(subject)}/acknowledge`;
  return send(path, { id, by }, "POST");
}

/** Address of the table of assets. */
export function assetsFile() {
  return new URL(`api/v1/assets.csv${ofSite()}`, document.baseURI).href;
}

function send(path, value, method = "PUT") {
  const headers = { "content-type": "application/json" };
  return fetchJson(path + ofSite(), { method, headers, body: JSON.stringify(value) });
}

/** Give the survey program all that the user knows; throws an Error that names the field that is wrong. */
export function putFacts(facts, floor_plan) {
  return send("api/survey/facts", { facts, floor_plan });
}

/** Have the survey program save the result of a number. */
export function saveSurvey(serial) {
  return send("api/survey/save", { serial }, "POST");
}

/** Store the image of the floor, a PNG or JPEG. @param {Blob} image */
export function putFloorPlan(image) {
  return fetchJson(`api/floor_plan${ofSite()}`, { method: "PUT", headers: { "content-type": image.type }, body: image });
}

/** The values of an overlay on a grid, also with some anchors elsewhere. */
export function overlay(kind, step_m, anchors = []) {
  const body = anchors.length ? { method: "POST", body: JSON.stringify({ anchors }) } : {};
  return fetchJson(`api/overlay${ofSite(`kind=${encodeURIComponent(kind)}&step_m=${step_m}`)}`, body);
}

/** The sheet for those who mount the anchors, a PDF, also with some anchors elsewhere. @returns {Promise<Blob>} */
export function installersSheet(anchors) {
  return fetchJson(`api/sheet${ofSite()}`, { method: "POST", body: JSON.stringify({ anchors }) }, (answer) => answer.blob());
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

/**
 * Address of the floor plan's image: of a recording, or with null of the live site, whose digest differs by image; and
 * there of the floor of a number, or with null of the whole site.
 */
export function floorPlanOf(name, digest, floor = null) {
  const query = floor === null ? `digest=${digest}` : `digest=${digest}&floor=${floor}`;
  const path = name === null ? `api/floor_plan${ofSite(query)}` : `api/recordings/${encodeURIComponent(name)}/floor_plan`;
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
