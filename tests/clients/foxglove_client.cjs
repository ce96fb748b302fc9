// Foxglove's own client: subscribes every channel, compiles its schema, prints what comes as JSON lines. Foxglove's messages are
// checked with Foxglove's own schemas, and may have no property that those do not have.
// node foxglove_client.cjs FOLDER_OF_MODULES URL SUBPROTOCOL
const [folder, url, subprotocol] = process.argv.slice(2);
const { createRequire } = require("node:module");
const load = createRequire(`${folder}/package.json`);
const { FoxgloveClient } = load("@foxglove/ws-protocol");
const { WebSocket } = load("ws");
const Ajv = load("ajv");
const official = load("@foxglove/schemas/jsonschema");

const print = (value) => process.stdout.write(`${JSON.stringify(value)}\n`);
const schemas = new Ajv({ strict: false });
const subscribed = new Map();

// The schema with all objects closed.
function closed(schema) {
  if (Array.isArray(schema)) return schema.map(closed);
  if (schema === null || typeof schema !== "object") return schema;
  const parts = Object.fromEntries(Object.entries(schema).map(([key, value]) => [key, closed(value)]));
  return schema.type === "object" && schema.properties ? { ...parts, additionalProperties: false } : parts;
}

const client = new FoxgloveClient({ ws: new WebSocket(url, [subprotocol]) });

client.on("serverInfo", (info) => print({ event: "serverInfo", info }));
client.on("status", (status) => print({ event: "status", status }));
client.on("error", (error) => print({ event: "error", error: String(error) }));
client.on("close", () => process.exit(0));
client.on("advertise", (channels) => {
  for (const channel of channels) {
    const stated = schemas.compile({ ...JSON.parse(channel.schema), $id: `/${channel.id}` });
    const [from, name] = channel.schemaName.split(".");
    const own = from === "foxglove" ? schemas.compile(closed(official[name])) : undefined;
    const check = own === undefined ? () => true : (value) => stated(value) && own(value);
    subscribed.set(client.subscribe(channel.id), { channel, check });
    print({ event: "channel", topic: channel.topic, schema: channel.schemaName, encoding: channel.encoding });
  }
});
client.on("message", ({ subscriptionId, timestamp, data }) => {
  const { channel, check } = subscribed.get(subscriptionId);
  const value = JSON.parse(new TextDecoder().decode(data));
  print({ event: "message", topic: channel.topic, ns: String(timestamp), valid: check(value), value });
});
