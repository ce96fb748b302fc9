// What the program RUNNER in core_build.py does, by the WebAssembly of skyless_core.c: node run_core.mjs FILE.wasm SIZES

import { readFileSync, writeSync } from "node:fs";

const [wasm, ...sizes] = process.argv.slice(2);
const [stateSize, placeSize, packetSize, relaySize, rowSize] = sizes.map(Number);
const input = readFileSync(0);
const counts = new Int32Array(input.buffer.slice(input.byteOffset, input.byteOffset + 16));
const module = new WebAssembly.Module(readFileSync(wasm));
const imports = WebAssembly.Module.imports(module);
if (imports.length) throw new Error(`it needs ${imports.map((one) => one.name)}`);
const { exports } = new WebAssembly.Instance(module, {});

let at = 16;
let end = Math.ceil(exports.__heap_base.value / 64) * 64;
function placed(size) {
  const begin = end;
  end = Math.ceil((begin + size) / 64) * 64;
  const missing = end - exports.memory.buffer.byteLength;
  if (missing > 0) exports.memory.grow(Math.ceil(missing / 65536));
  return begin;
}
function read(size) {
  const begin = placed(size);
  new Uint8Array(exports.memory.buffer).set(input.subarray(at, at + size), begin);
  at += size;
  return begin;
}

const state = read(stateSize);
const places = read(counts[0] * placeSize);
const packets = read(counts[1] * packetSize);
const relays = read(counts[2] * relaySize);
const rows = placed(counts[1] * rowSize);
exports.skyless_track(state, places, packets, relays, rows, counts[1], counts[3]);
function write(begin, size) {
  const bytes = new Uint8Array(exports.memory.buffer, begin, size);
  for (let done = 0; done < size; ) done += writeSync(1, bytes, done);
}
write(rows, counts[1] * rowSize);
write(state, stateSize);
