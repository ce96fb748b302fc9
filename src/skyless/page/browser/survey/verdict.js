/** How the survey stands, in one sentence: it is good only where nothing speaks against it. */

import { state } from "../store.js";
import { length, sentence } from "../format.js";
import { age_s, isInUse, noData, pending, presence } from "./model.js";

/** Start of the survey program; `ADDRESS` is the broker's. A site is named after its file unless somebody renamed it. */
export function command() {
  const name = state.site?.name ?? "";
  const file = /^[\w.-]+$/.test(name) ? name : "site";
  return `skyless survey --mqtt ${state.mqtt?.broker || "ADDRESS"} --site ${file}.toml --serve`;
}

/**
 * What the newest result is worth.
 * @returns {{kind: "good"|"note"|"warn"|"bad", title: string, words: string}}
 */
export function verdict() {
  return absent() ?? unstarted() ?? unfinished() ?? open() ?? weak() ?? good();
}

/** The same, but at a site that is in use and that nobody sets up, what another survey would leave open is no fault. */
export function headline() {
  if (!isInUse()) return verdict();
  const again = "All anchors have positions. To survey them again, ";
  const inUse = (words) => ({ kind: "note", title: "In use", words: again + words });
  if (!absent() && unstarted()) return inUse("start the survey program with the command below.");
  const words = "go through the steps; step 5 says what their ranges leave open.";
  return absent() ?? unfinished() ?? ((open() ?? weak()) ? inUse(words) : good());
}

/** What keeps the newest result from being shown at all. */
function absent() {
  if (state.connection.phase !== "open") {
    return bad("Connection lost", "What is shown here is old until the page is connected again.");
  }
  if (state.mqtt && !state.mqtt.connected) {
    return bad("No broker", "The server has lost its broker: nothing new arrives from the survey program.");
  }
  if (presence() === "old") {
    const old = Math.floor(age_s());
    return bad("Old", `The survey program has sent nothing for ${old} s. What is shown here may have changed since.`);
  }
  return null;
}

/** That there is no survey program. */
function unstarted() {
  if (presence() !== "none") return null;
  return bad("No survey program", "Nothing is surveyed now. Start the survey program with the command below.");
}

/** Why there is no result. */
function unfinished() {
  const { survey, error, anchors } = state.survey;
  if (noData()) return bad("No data", sentence(error ?? "the survey program receives nothing of the anchors"));
  if (error) return bad("Problem", sentence(error));
  if (pending() === "late") {
    return bad("Not used yet", "The survey program does not use what you have given. Give it again, or look at its log.");
  }
  if (pending()) return { kind: "note", title: "Computing", words: "What you have given is on its way." };
  if (!survey) {
    const heard = anchors.length === 1 ? "1 anchor has" : `${anchors.length} anchors have`;
    return { kind: "note", title: "Gathering", words: `${heard} been received; too few pairs for a result yet.` };
  }
  return null;
}

/** What the result does not determine. */
function open() {
  const { survey } = state.survey;
  const ids = survey.anchors.filter((anchor) => !anchor.determined).map((anchor) => anchor.id);
  if (ids.length) {
    const words = ids.length === 1 ? `Anchor ${ids[0]} is not determined.` : `${ids.length} anchors are not determined: ${list(ids)}.`;
    return bad("Not determined", words);
  }
  if (survey.not_determined.length) return bad("Not fully determined", sentence(survey.not_determined[0]));
  return null;
}

/** Why the result is not to be relied on as it is. */
function weak() {
  const { survey, missing } = state.survey;
  if (survey.ambiguities.length) {
    const others = count(survey.ambiguities.length, "other result fits", "other results fit");
    return warn("Ambiguous", `${others} the ranges as well. Step 5 says which.`);
  }
  if (survey.unchecked) return warn("Unchecked", sentence(survey.unchecked));
  if (survey.assumed_heights) return warn("Heights", `${sentence(survey.assumed_heights)} Step 3 asks for them.`);
  if (missing.length) {
    return warn("Incomplete", `${count(missing.length, "anchor has", "anchors have")} not been received: ${list(missing)}.`);
  }
  return null;
}

function good() {
  const { survey } = state.survey;
  const worst = Math.max(...survey.anchors.map((anchor) => anchor.std_m ?? 0));
  const words = `All ${survey.anchors.length} anchors are determined and checked, to ±${length(worst)} or better.`;
  if (survey.notes.length) return { kind: "note", title: "Read the notes", words: `${words} ${sentence(survey.notes[0])}` };
  return { kind: "good", title: "Good", words };
}

function bad(title, words) {
  return { kind: "bad", title, words };
}

function warn(title, words) {
  return { kind: "warn", title, words };
}

function count(number, one, more) {
  return number === 1 ? `1 ${one}` : `${number} ${more}`;
}

/** Numbers as words: the first few of them. */
export function list(numbers, most = 8) {
  const shown = numbers.slice(0, most).join(", ");
  return numbers.length > most ? `${shown} and ${numbers.length - most} more` : shown;
}
