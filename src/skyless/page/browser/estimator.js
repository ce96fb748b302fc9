/** The estimator in this browser: WebAssembly that is made from the same source as the server's library. */

const ALIGNMENT = 64;
const PAGE_BYTES = 65536;
/** What became of a packet (`core/estimator/process.py`). */
const REJECTED = 0;
const STALE = 3;

let module = null;

/**
 * Recompute packets, with changes; a row for each packet: its position, level and whether it was used.
 * @param {object} found what the server has prepared
 * @param {{without: Set<number>, moved_m: Map<number, number[]>, noise: number}} changes by anchors' identifiers
 */
export async function recompute(found, changes) {
  module ??= await compiled();
  const { exports } = new WebAssembly.Instance(module, {});
  const memory = new Memory(exports);
  if (memory.text(exports.skyless_source_digest.value) !== found.digest) {
    throw new Error("The page and the server are of different versions of Skyless. Reload the page.");
  }
  const { layout } = found;
  const state = memory.place(layout.State);
  for (const [at, page] of found.state) memory.write(state + at, bytesOf(page));
  for (const name of ["State.tx_variance_m2", "State.rx_variance_m2"]) {
    memory.setReal(state + layout[name], memory.real(state + layout[name]) * changes.noise ** 2);
  }
  const places = memory.store(bytesOf(found.places));
  found.anchors.forEach(({ id }, index) => {
    const at = places + index * layout.Place + layout["Place.position_m"];
    (changes.moved_m.get(id) ?? []).forEach((by_m, axis) => memory.setReal(at + 8 * axis, memory.real(at + 8 * axis) + by_m));
  });
  const kept = keptPackets(found, changes.without);
  const packets = memory.store(kept.packets);
  const relays = memory.store(kept.relays);
  const rows = memory.place(kept.numbers.length * layout.BatchRow);
  exports.skyless_track(state, places, packets, relays, rows, kept.numbers.length, 1);
  return kept.numbers.map((number, index) => {
    const row = rows + index * layout.BatchRow;
    const outcome = memory.int(row + layout["BatchRow.outcome"]);
    const position_m = [0, 1, 2].map((axis) => memory.real(row + layout["BatchRow.position_m"] + 8 * axis));
    const level_m = memory.real(row + layout["BatchRow.hpl_m"]);
    const used = outcome !== REJECTED && outcome !== STALE;
    return { number, used, position_m, hpl_m: level_m > 0 && Number.isFinite(level_m) ? level_m : null };
  });
}

async function compiled() {
  let answer;
  try {
    answer = await fetch(new URL("page/skyless_core.wasm", document.baseURI));
  } catch {
    throw new Error("The server does not respond.");
  }
  if (!answer.ok) throw new Error("The server has no estimator for browsers.");
  try {
    return await WebAssembly.compile(await answer.arrayBuffer());
  } catch (error) {
    throw new Error(`This browser cannot run the estimator: ${error.message}`);
  }
}

/** The packets of all anchors but some, and the relays that came with them. */
function keptPackets({ anchors, packets, relays, layout }, without) {
  const given = bytesOf(packets);
  const given_relays = bytesOf(relays);
  const view = new DataView(given.buffer);
  const numbers = [];
  const kept = [];
  const kept_relays = [];
  let begin = 0;
  let end_kept = 0;
  for (let number = 0; number * layout.BatchPacket < given.length; number++) {
    const at = number * layout.BatchPacket;
    const end = view.getInt32(at + layout["BatchPacket.end"], true);
    if (!without.has(anchors[view.getInt32(at + layout["BatchPacket.place"], true)].id)) {
      end_kept += end - begin;
      view.setInt32(at + layout["BatchPacket.end"], end_kept, true);
      numbers.push(number);
      kept.push(given.subarray(at, at + layout.BatchPacket));
      kept_relays.push(given_relays.subarray(begin * layout.Relay, end * layout.Relay));
    }
    begin = end;
  }
  return { numbers, packets: joined(kept), relays: joined(kept_relays) };
}

function joined(parts) {
  const all = new Uint8Array(parts.reduce((size, part) => size + part.length, 0));
  let at = 0;
  for (const part of parts) {
    all.set(part, at);
    at += part.length;
  }
  return all;
}

function bytesOf(base64) {
  return Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0));
}

/** The memory of an instance; what is placed in it stays. */
class Memory {
  constructor(exports) {
    this.memory = exports.memory;
    this.end = exports.__heap_base.value;
  }

  /** Space of a size, all zeros. */
  place(size) {
    const begin = Math.ceil(this.end / ALIGNMENT) * ALIGNMENT;
    this.end = begin + size;
    const missing = this.end - this.memory.buffer.byteLength;
    if (missing > 0) this.memory.grow(Math.ceil(missing / PAGE_BYTES));
    return begin;
  }

  store(bytes) {
    const begin = this.place(bytes.length);
    this.write(begin, bytes);
    return begin;
  }

  write(at, bytes) {
    new Uint8Array(this.memory.buffer).set(bytes, at);
  }

  get view() {
    return new DataView(this.memory.buffer);
  }

  real(at) {
    return this.view.getFloat64(at, true);
  }

  setReal(at, value) {
    this.view.setFloat64(at, value, true);
  }

  int(at) {
    return this.view.getInt32(at, true);
  }

  /** A text that ends with a zero, by the address of its address. */
  text(at) {
    const bytes = new Uint8Array(this.memory.buffer, this.int(at));
    return new TextDecoder().decode(bytes.subarray(0, bytes.indexOf(0)));
  }
}
