/** "What if": a piece of a recording once more in this browser, without an anchor, with one moved, or with other noise. */

import { state } from "./store.js";
import { h, options, s } from "./dom.js";
import { recording, whatIf } from "./api.js";
import { clock } from "./format.js";
import { recompute } from "./estimator.js";

const SECONDS = 30;
const LEAST_ANCHORS = 3;
const MARGIN_M = 0.5;

/** Open the dialog for the moment that is shown of a recording. */
export function openWhatIf() {
  openDialog().catch(showFailure);
}

const failure = h("p", { class: "problem", role: "alert" });

function showFailure(error) {
  failure.textContent = error.message;
}

async function openDialog() {
  const { player } = state;
  const from_s = player.at_s;
  failure.textContent = "";
  const content = h("div", { class: "what-if-content" });
  const close = h("button", { type: "button", onclick: () => dialog.close() }, "Close");
  const title = h("h2", { id: "what-if-title" }, "What if…");
  const dialog = h("dialog", { id: "what-if-dialog", "aria-labelledby": "what-if-title" }, title, content, failure, close);
  dialog.addEventListener("close", () => dialog.remove());
  document.body.append(dialog);
  dialog.showModal();
  const { tags } = await recording(player.name);
  if (!tags.length) throw new Error("There is no tag in this recording.");
  const show = (tag) => prepare(content, player, tag, from_s).catch(showFailure);
  const choice = options({ id: "what-if-tag" }, tags.map((tag) => [tag, tag]), show);
  title.after(h("label", { for: "what-if-tag" }, "Tag "), choice);
  await show(tags[0]);
}

/** Fetch the packets of a tag, and build the form. */
async function prepare(content, player, tag, from_s) {
  failure.textContent = "";
  content.replaceChildren(h("p", {}, "Preparing the packets…"));
  let found;
  try {
    found = await whatIf(player.name, tag, from_s, SECONDS);
  } catch (error) {
    content.replaceChildren();
    throw error;
  }
  const anchors = found.anchors.toSorted((a, b) => a.id - b.id).map(anchorRow);
  const noise = h("input", { type: "number", id: "what-if-noise", value: "1", min: "0.1", max: "100", step: "0.1" });
  const result = h("div", { class: "what-if-result", role: "status" });
  const run = () => show(result, found, changesOf(anchors, noise)).catch(showFailure);
  const begin_s = from_s + found.begin_s;
  content.replaceChildren(
    h(
      "p",
      {},
      `Recomputed in this browser from the ${found.times_s.length} beacons that tag ${tag} received from ${clock(begin_s)} to `,
      `${clock(begin_s + (found.times_s.at(-1) ?? 0))}, beginning where the tag was then. Nothing at the site changes.`,
    ),
    h(
      "table",
      {},
      h("tr", {}, ...["anchor", "used", "Δx [m]", "Δy [m]", "Δz [m]"].map((words) => h("th", { scope: "col" }, words))),
      ...anchors.map(({ row }) => row),
    ),
    h("label", { for: "what-if-noise" }, "Noise that the filter assumes of stamps, × "),
    noise,
    h("button", { type: "button", id: "what-if-run", onclick: run }, "Recompute"),
    result,
  );
  await run();
}

function anchorRow({ id }) {
  const used = h("input", { type: "checkbox", checked: true, "aria-label": `Anchor ${id} is used` });
  const by = ["x", "y", "z"].map((axis) =>
    h("input", { type: "number", value: "0", step: "0.05", min: "-100", max: "100", "aria-label": `Anchor ${id} moved by, ${axis}` }),
  );
  const row = h("tr", {}, h("th", { scope: "row" }, String(id)), h("td", {}, used), ...by.map((input) => h("td", {}, input)));
  return { id, used, by, row };
}

/** What the form says. Throws an Error that names what is wrong. */
function changesOf(anchors, noise) {
  const numbers = [noise, ...anchors.flatMap(({ by }) => by)];
  const wrong = numbers.find((input) => !input.checkValidity() || !Number.isFinite(input.valueAsNumber));
  if (wrong) {
    wrong.focus();
    const name = wrong.getAttribute("aria-label") ?? "The noise";
    return Promise.reject(new Error(`${name}: it should be a number from ${wrong.min} to ${wrong.max}.`));
  }
  const without = new Set(anchors.filter(({ used }) => !used.checked).map(({ id }) => id));
  if (anchors.length - without.size < LEAST_ANCHORS) {
    return Promise.reject(new Error(`A position needs ${LEAST_ANCHORS} anchors; tick more of them.`));
  }
  const moved_m = new Map(anchors.map(({ id, by }) => [id, by.map((input) => input.valueAsNumber)]));
  return Promise.resolve({ without, moved_m, noise: noise.valueAsNumber });
}

async function show(result, found, asked) {
  failure.textContent = "";
  const changes = await asked;
  const rows = await recompute(found, changes);
  const used = rows.filter((row) => row.used);
  const recorded = found.recorded.filter((one) => one !== null);
  const away_m = used.flatMap(({ number, position_m: [x, y] }) => {
    const then = found.recorded[number];
    return then ? [Math.hypot(x - then[0], y - then[1])] : [];
  });
  const levels_m = used.flatMap(({ hpl_m }) => (hpl_m === null ? [] : [hpl_m]));
  const recorded_m = recorded.flatMap(([, , , hpl_m]) => (hpl_m === null ? [] : [hpl_m]));
  const figures = [
    ["", "recorded", "recomputed"],
    ["fixes", recorded.length, used.length],
    ["horizontal protection level, median", metres(quantile(recorded_m, 0.5)), metres(quantile(levels_m, 0.5))],
    ["distance between both, median", "", metres(quantile(away_m, 0.5))],
    ["distance between both, 95 %", "", metres(quantile(away_m, 0.95))],
  ];
  const table = figures.map(([name, ...values]) =>
    h("tr", {}, h("th", { scope: "row" }, name), ...values.map((value) => h("td", {}, String(value)))),
  );
  const drawing = drawn(found, changes, recorded, used);
  result.replaceChildren(h("table", { id: "what-if-figures" }, ...table), drawing);
  if (!used.length) throw new Error("No packet fits: with these changes there are no positions.");
}

function quantile(values, share) {
  return values.toSorted((a, b) => a - b)[Math.floor(share * (values.length - 1))] ?? NaN;
}

function metres(value) {
  return Number.isFinite(value) ? `${value.toFixed(3)} m` : "none";
}

/** Both tracks and the anchors, seen from above. */
function drawn(found, { without, moved_m }, recorded, used) {
  const anchors = found.anchors.map(({ id, position_m: [x, y] }) => {
    const [dx, dy] = moved_m.get(id) ?? [0, 0];
    return { id, x: x + dx, y: y + dy };
  });
  const xs = [...anchors.map(({ x }) => x), ...recorded.map(([x]) => x)];
  const ys = [...anchors.map(({ y }) => y), ...recorded.map(([, y]) => y)];
  const [left, right] = [Math.min(...xs) - MARGIN_M, Math.max(...xs) + MARGIN_M];
  const [low, high] = [Math.min(...ys) - MARGIN_M, Math.max(...ys) + MARGIN_M];
  const points = (places) => places.map(([x, y]) => `${x.toFixed(3)},${(-y).toFixed(3)}`).join(" ");
  const scale = (right - left) / 300;
  const words = "The recorded track, thin, and the recomputed one, seen from above";
  return s(
    "svg",
    { viewBox: `${left} ${-high} ${right - left} ${high - low}`, role: "img", "aria-label": words, class: "what-if-map" },
    s("polyline", { points: points(recorded), class: "recorded", "stroke-width": scale }),
    s("polyline", { points: points(used.map((row) => row.position_m)), class: "recomputed", "stroke-width": 2 * scale }),
    ...anchors.map(({ id, x, y }) =>
      s("circle", { cx: x, cy: -y, r: 3 * scale, "stroke-width": scale, class: without.has(id) ? "without" : "" }),
    ),
  );
}
