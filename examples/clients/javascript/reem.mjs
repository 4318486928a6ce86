// A client of REEM for node, without a package, for a server with the JSON module. It follows docs/wire.md.
//   node reem.mjs redis://localhost:6379 get arm.q
//   node reem.mjs redis://localhost:6379 publish arm '{"speed":0.5}'
//   node reem.mjs redis://localhost:6379 watch arm.q 10
//   node reem.mjs redis://localhost:6379 call arm.plan '{"goal":2}'
import { randomBytes } from "node:crypto";
import net from "node:net";

const check = (ok, why) => { if (!ok) throw new Error(why); };
process.on("uncaughtException", (error) => {
  console.error(`error: ${(error.message || error.code).replace(/\s+/g, " ")}`);
  process.exit(1);
});

const [url, action, place, word] = process.argv.slice(2);
const [, host, port = 6379] = /^redis:\/\/([^:/@]+)(?::(\d+))?$/.exec(url) ?? [];
const [, key, path] = /^([\w:]+)((?:\.\w+|\[\d+\])*)$/.exec(place) ?? [];
check(host && key, "usage: node reem.mjs redis://HOST:PORT get|publish|watch|call PLACE [JSON | LINES]");
const tag = `{${key}}`, id = randomBytes(8).toString("hex"), messages = [];
const socket = net.connect(port, host), pieces = socket[Symbol.asyncIterator]();
let received = Buffer.alloc(0), arriving = null;
socket.setTimeout(5000, () => check(false, "the server does not answer"));

// Return what is received up to the end of a line, at least so many bytes.
async function receive(size) {
  let end;
  while ((end = received.indexOf("\r\n", size)) < 0) {
    const { value, done } = await (arriving ??= pieces.next());
    check(!done, "the server closed the connection");
    received = Buffer.concat([received, value]);
    arriving = null;
  }
  const found = received.subarray(0, end);
  received = received.subarray(end + 2);
  return found;
}

// Return the next reply: text, bytes, a list, or null. A message of a channel is a list with `isMessage`.
async function next() {
  const line = String(await receive(0)), kind = line[0], size = Number(line.slice(1)), items = [];
  check(kind !== "-", `the server refused: ${line.slice(1)}`);
  if (kind === "_" || size === -1) return null;
  if (kind === "+" || kind === ":") return line.slice(1);
  check(line && "$*~>%".includes(kind) && size >= 0 && size < 2 ** 26, "the server sent what is not a reply");
  const bytes = kind === "$" && await receive(size);
  check(!bytes || bytes.length === size, "the server sent a text of another size than it announced");
  if (bytes) return bytes;
  while (items.length < (kind === "%" ? 2 * size : size)) items.push(await next());
  return Object.assign(items, { isMessage: kind === ">" });
}

// Send commands and return the reply to the last one. Messages that come before it are kept.
async function ask(...commands) {
  let reply;
  for (const words of commands) {
    const sized = words.flatMap((it) => [`$${Buffer.byteLength(it)}\r\n`, it, "\r\n"]);
    socket.write(Buffer.concat([`*${words.length}\r\n`, ...sized].map((it) => Buffer.from(it))));
    while ((reply = await next())?.isMessage) messages.push(reply);
  }
  return reply;
}

// Return the next message, or nothing after a second.
async function message() {
  const second = new Promise((wake) => setTimeout(wake, 1000));
  if (!received.length && !messages.length) await Promise.race([arriving ??= pieces.next(), second]);
  await ask(["PING"]); // reads what has arrived
  return messages.shift();
}

async function subscribe(channel) {
  socket.write(`SUBSCRIBE ${tag}:${channel}\r\n`);
  while ((await message()) === undefined); // its confirmation
}

// Return JSON of a value: of JSON that has no placeholder, or of the array to which the placeholder belongs.
function shown(json, npy) {
  const form = /^\x93NUMPY\x01\x00v\x00\{'descr': '<f8', 'fortran_order': False, 'shape': \((\d+),\), \} *\n/;
  if (!json.startsWith(`"$ship numpy ${path} `) || npy === null) {
    check(!json.includes('"$ship '), `${place} has more than JSON: get one array, such as arm.q`);
    return json;
  }
  const [header, count] = form.exec(npy.toString("latin1", 0, 128)) ?? [];
  check(npy.length === header?.length + 8 * count, `${place} is not an array of float64 with one dimension`);
  const data = Array.from({ length: count }, (_, at) => npy.readDoubleLE(header.length + 8 * at));
  return `{"dtype":"<f8","shape":[${count}],"data":[${data}]}`;
}

// Return value and note of one instant. The note is publisher and number of the last update.
async function read() {
  const reads = [["JSON.GET", key, `$${path}`], ["GET", tag + path], ["GET", `${tag}:last`]];
  const [list, npy, note] = await ask(["MULTI"], ...reads, ["EXEC"]);
  const [, json] = /^\[(.*)\]$/s.exec(list ?? "[]") ?? check(false, "the server sent another reply than expected");
  return [shown(json, npy), note && String(note)];
}

// Print the value, and again after each change. A notice is a reason to read, and each second is one.
async function watch(lines) {
  await subscribe("notices");
  for (let last, known = null; ; await message()) {
    const [json, note] = await read();
    known = note ?? known; // a note expires
    const line = `{"update":${JSON.stringify(known)},"value":${json || "null"}}`;
    if (line === last) continue;
    console.log(line);
    if (--lines === 0) return;
    last = line;
  }
}

// Replace a key by JSON and have its subscribers read it, in one transaction. RedisJSON reads 15 digits exactly.
async function publish(json) {
  const notice = `${JSON.stringify([1, id, 1, Date.now() / 1000, [], "look", 0, []])}\n`;
  const isExact = !/[\d.]{17}|\d[eE]/.test(json);
  check(isExact && !json.includes('"$ship '), "over 15 digits, an exponent, or a text that begins with $ship");
  await ask(["WATCH", key, `${tag}:ships`, `${tag}:lease`], ["JSON.TYPE", key]); // refused for a key of another program
  check(await ask(["EXISTS", `${tag}:lease`]) === "0", `${key} is owned by another program`);
  check(await ask(["EXISTS", `${tag}:ships`]) === "0", `${key} has arrays, which this client would leave behind`);
  const last = ["SET", `${tag}:last`, `${id} 1`, "EX", "60"], announced = ["PUBLISH", `${tag}:notices`, notice];
  const replies = await ask(["MULTI"], ["JSON.SET", key, "$", json], last, announced, ["EXEC"]);
  check(replies !== null, `another client wrote ${key} at the same time: publish again`);
}

// Send arguments to one program that serves, and return its answer. Both sides give up after ten seconds.
async function call(json) {
  await subscribe(`answers@${id}`);
  const [channel] = await ask(["PUBSUB", "CHANNELS", `${tag}${path}:serve@${"?".repeat(16)}`]);
  check(channel !== undefined, `no program serves ${place}`);
  const head = [1, "call", id, id, 10, ["", ""], "here", Buffer.byteLength(json), []];
  const reached = await ask(["PUBLISH", channel, `${JSON.stringify(head)}\n${json}`]);
  check(reached !== "0", `the program that served ${place} has just ended: call again`);
  let payload;
  for (const end = Date.now() + 10_000; !payload && Date.now() < end; ) payload = (await message())?.[2];
  check(payload, "no answer in 10 s; the call may or may not have been handled");
  const line = String(payload).split("\n", 1)[0], answer = payload.subarray(Buffer.byteLength(line) + 1);
  const [version, kind, number, server, , texts, where, size] = JSON.parse(line);
  check(version === 1 && number === id && server === String(channel).slice(-16), "an answer to something else");
  check(kind === "answer", `${kind}: ${JSON.stringify(texts)}`);
  check(where === "here" && size === answer.length, "the answer has arrays, or over 64 kB");
  return shown(String(answer), null);
}

if (action === "publish" || action === "call") JSON.parse(word); // an error if it is none
await ask(["HELLO", "3"]);
if (action === "get") console.log((await read())[0] || check(false, `nothing is stored at ${place}`));
else if (action === "publish" && !path) await publish(word);
else if (action === "watch") await watch(Number(word) || Infinity);
else if (action === "call") console.log(await call(word));
else check(false, `cannot ${action} ${place}`);
process.exit(0);
