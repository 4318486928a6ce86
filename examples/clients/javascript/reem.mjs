// A client of REEM for node without a package from npm. It follows docs/wire.md.
//
//   node reem.mjs redis://localhost:6379 get arm.q
//   node reem.mjs redis://localhost:6379 publish arm speed=0.5 mode=auto q=0,0.5,1
//   node reem.mjs redis://localhost:6379 watch arm 10
//   node reem.mjs redis://localhost:6379 call arm.plan goal=2 start=0,0.5
import { randomBytes } from "node:crypto";
import net from "node:net";

const LARGEST = 2 ** 29, IN_NOTICE = 2 ** 14, IN_REQUEST = 2 ** 16; // bytes of a reply, and of values in messages
const ITEMS = { b1: "Uint8", i1: "Int8", u1: "Uint8", i2: "Int16", u2: "Uint16", i4: "Int32", u4: "Uint32" };
Object.assign(ITEMS, { i8: "BigInt64", u8: "BigUint64", f4: "Float32", f8: "Float64" }); // of numpy, and of a DataView

class Failure extends Error {}
const check = (ok, why) => { if (!ok) throw new Failure(why); };
const newId = (size) => randomBytes(size).toString("hex");
const now = () => performance.now() / 1000; // seconds

// One connection with RESP3: replies, and in order with them the messages of channels.
class Connection {
  messages = []; // that are not handled yet
  #pieces = []; // bytes that are not read yet
  #size = 0;
  #ended = null;
  #wake = () => {};

  static async open(text) {
    const url = new URL(text), it = new Connection(), password = decodeURIComponent(url.password);
    check(url.protocol === "redis:" && ["", "/", "/0"].includes(url.pathname), "the URL is not like redis://[user:password@]host[:port]");
    const end = (why) => { it.#ended ??= why; it.#wake(); };
    it.socket = net.connect(Number(url.port || 6379), url.hostname);
    it.socket.on("data", (piece) => { it.#size += it.#pieces.push(piece) && piece.length; it.#wake(); });
    it.socket.on("error", (error) => end(error.message)).on("close", () => end("the server closed the connection"));
    const hello = await it.send("HELLO", "3", ...(password ? ["AUTH", url.username || "default", password] : []));
    const words = hello.map(String), mode = words.includes("mode") ? words[words.indexOf("mode") + 1] : "standalone";
    check(mode === "standalone", `this is not a single server, but: ${mode}`);
    // A server without the JSON module holds documents as text
    it.hasJson = await it.send("JSON.TYPE", "_").then(() => true, (error) => {
      if (!error.message.includes("ERR unknown command")) throw error;
      return false;
    });
    return it;
  }

  // Wait for more bytes; false if none came in time.
  async #more(seconds) {
    check(this.#ended === null, this.#ended);
    let timer;
    await new Promise((wake) => { this.#wake = wake; timer = setTimeout(wake, seconds * 1000, "late"); })
      .then((late) => { if (late && seconds >= 5) this.#ended = "the server does not answer"; });
    clearTimeout(timer);
  }

  get #received() {
    if (this.#pieces.length !== 1) this.#pieces = [Buffer.concat(this.#pieces)];
    return this.#pieces[0];
  }

  async #bytes(count) {
    while (this.#size < count) await this.#more(5);
    const all = this.#received;
    this.#pieces = [all.subarray(count)];
    this.#size -= count;
    return all.subarray(0, count);
  }

  async #frame(depth = 0) {
    let end;
    while ((end = this.#received.indexOf("\r\n")) < 0) {
      check(this.#received.length < 65536, "the server sent a line without an end");
      await this.#more(5);
    }
    const line = (await this.#bytes(end + 2)).toString().slice(0, -2), kind = line[0] ?? "?", text = line.slice(1);
    check(depth < 8 && "+-:_,#$=*~>%".includes(kind), `the server sent ${JSON.stringify(line.slice(0, 40))}, which is no reply`);
    if ("+,#".includes(kind)) return text;
    if ("-_".includes(kind)) return kind === "-" ? new Failure(`the server refused: ${text}`) : null;
    const count = Number(text);
    check(/^-?\d+$/.test(text), `the server sent ${JSON.stringify(line.slice(0, 40))}, which is no number`);
    if (kind === ":" || count === -1) return kind === ":" ? count : null;
    check(count >= 0 && count <= LARGEST, `the server sent a reply of ${count} bytes or items`);
    if ("$=".includes(kind)) {
      const found = await this.#bytes(count + 2);
      check(found.toString("latin1", count) === "\r\n", "the server sent a text of another length than it said");
      return found.subarray(0, count);
    }
    const items = [];
    for (let left = count * (kind === "%" ? 2 : 1); left > 0; left--) items.push(await this.#frame(depth + 1));
    return kind === ">" ? Object.assign(items, { isPush: true }) : items;
  }

  async #next() {
    const found = await this.#frame();
    if (found?.isPush && String(found[0]) === "message") this.messages.push(found[2]);
    return found;
  }

  // Send a command and return its reply, or the confirmation of a subscription.
  async send(...words) {
    const parts = words.map((it) => (Buffer.isBuffer(it) ? it : Buffer.from(String(it))));
    const framed = parts.flatMap((it) => [Buffer.from(`$${it.length}\r\n`), it, Buffer.from("\r\n")]);
    this.socket.write(Buffer.concat([Buffer.from(`*${parts.length}\r\n`), ...framed]));
    for (;;) {
      const found = await this.#next();
      if (found instanceof Failure) throw found;
      if (!found?.isPush || String(found[0]) === "subscribe") return found;
    }
  }

  // Return the next message, or null if there is none for so long.
  async wait(seconds) {
    if (!this.messages.length && !this.#size && seconds > 0) await this.#more(Math.min(seconds, 4));
    if (!this.messages.length && this.#size) check((await this.#next())?.isPush, "a reply to no command");
    check(this.messages.length || this.#ended === null, this.#ended);
    return this.messages.shift() ?? null;
  }
}

// Documents and arrays.

// Return the value of JSON; integers that a number of JavaScript cannot hold become a BigInt, by a placeholder.
function parsed(text) {
  const token = /"(?:[^"\\]|\\.)*"|-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?/g;
  const exact = text.replace(token, (it) => (/^-?\d{16,}$/.test(it) ? `"$ship int ${it}"` : it));
  return JSON.parse(exact);
}

// Return container, key and suffix for each array in the only item of a list; texts and numbers are put in place.
function placeholders(holder, where) {
  const stack = [holder], found = [];
  while (stack.length) {
    const at = stack.pop();
    for (const [key, it] of Object.entries(at)) {
      if (it && typeof it === "object") stack.push(it);
      if (typeof it !== "string" || !it.startsWith("$ship ")) continue;
      const [, label, rest] = /^\$ship (\S*) ?(.*)$/s.exec(it) ?? [null, "", ""];
      if (label === "text") at[key] = rest;
      else if (label === "int") at[key] = BigInt(rest);
      else if (label === "float") at[key] = fromHex(rest, where);
      else {
        check(label === "numpy", `${where}: this client cannot read a value of the kind ${JSON.stringify(label)}`);
        found.push([at, key, decodeURIComponent(rest.split(" ")[0])]);
      }
    }
  }
  check(new Set(found.map((it) => it[2])).size === found.length, `${where}: two places have the same array`);
  return found;
}

function filled(holder, found, blobs, where) {
  found.forEach(([at, key, suffix], index) => { at[key] = array(blobs[index], where + suffix); });
  return holder[0];
}

function fromHex(text, where) {
  const [, sign, whole, fraction, power] = /^(-?)0x([\da-f]+)\.?([\da-f]*)p([+-]?\d+)$/.exec(text) ?? [];
  check(whole, `${where}: ${JSON.stringify(text.slice(0, 40))} is no float`);
  const all = Number(power) - 4 * fraction.length, half = Math.trunc(all / 2); // 2 ** all may be too small for a float
  return (sign ? -1 : 1) * Number(BigInt(`0x${whole}${fraction}`)) * 2 ** half * 2 ** (all - half);
}

// Return dtype, shape and items of an .npy file.
function array(blob, where) {
  check(Buffer.isBuffer(blob), `${where}: the array is gone from the server`);
  const start = blob.length > 10 ? 10 + blob.readUInt16LE(8) : 0, header = blob.toString("latin1", 10, start);
  const form = /^\{'descr': '([<>|])(\w\d)', 'fortran_order': False, 'shape': \(((?:\d{1,10}, ?)*\d{0,10})\), \} *\n$/;
  const [, order, code, sizes] = form.exec(header) ?? [];
  const readable = blob.toString("latin1", 0, 8) === "\x93NUMPY\x01\x00" && code in ITEMS;
  check(readable, `${where}: this client cannot read the array ${JSON.stringify(blob.toString("latin1", 0, 80))}`);
  const shape = sizes.split(",").map((it) => it.trim()).filter(Boolean).map(Number), size = Number(code[1]);
  const count = shape.reduce((product, it) => product * it, 1);
  check(count * size === blob.length - start, `${where}: the array has a wrong size`);
  const view = new DataView(blob.buffer, blob.byteOffset + start, count * size), get = `get${ITEMS[code]}`;
  const item = (_, index) => (code === "b1" ? Boolean(view.getUint8(index)) : view[get](index * size, order !== ">"));
  return { dtype: order + code, shape, data: Array.from({ length: count }, item) };
}

// Return the JSON of a number, exact on each server: long floats are hexadecimal.
function numberText(text) {
  if (/^-?\d+$/.test(text)) {
    check(BigInt(text) >= -(2n ** 63n) && BigInt(text) < 2n ** 64n, `${text} has more than 64 bits`);
    return String(BigInt(text));
  }
  const number = Number(text), short = String(number);
  check(Number.isFinite(number), `${text} is no number of JSON`);
  if (!short.includes("e") && short.length <= 16 && !Object.is(number, -0)) return short.includes(".") ? short : `${short}.0`;
  const view = new DataView(new ArrayBuffer(8));
  view.setFloat64(0, number);
  const bits = view.getBigUint64(0), power = Number((bits >> 52n) & 0x7ffn);
  const digits = (bits & (2n ** 52n - 1n)) + (power ? 2n ** 52n : 0n);
  return `"$ship float ${bits >> 63n ? "-" : ""}0x${digits.toString(16)}p${(power || 1) - 1075}"`;
}

// Return the text of a document, and parts and bytes of its arrays, for words such as `speed=0.5` and `q=0,0.5`.
function encoded(words, above) {
  const members = [], parts = [], blobs = [];
  for (const word of words) {
    const [, name, text] = /^([^=.[\]"'\\~%\s]+)=(.*)$/s.exec(word) ?? [];
    check(name, `${JSON.stringify(word)} is not like name=value`);
    const items = text.split(",").filter(Boolean);
    const isNumber = items.length && items.every((it) => /^[\d+.eE-]+$/.test(it) && !isNaN(it));
    let value = isNumber && !text.includes(",") ? numberText(text) : JSON.stringify(text.replace(/^\$ship /, "$$ship text $$ship "));
    if (isNumber && text.includes(",")) {
      const header = `{'descr': '<f8', 'fortran_order': False, 'shape': (${items.length},), }`;
      const data = Buffer.alloc(8 * items.length), length = 64 * Math.ceil((header.length + 11) / 64) - 10;
      items.forEach((it, index) => data.writeDoubleLE(Number(it), 8 * index));
      const before = Buffer.from(`\x93NUMPY\x01\x00\x00\x00${`${header.padEnd(length - 1)}\n`}`, "latin1");
      before.writeUInt16LE(length, 8);
      blobs.push(Buffer.concat([before, data]));
      parts.push(["numpy", `${above}.${name}`, blobs.at(-1).length]);
      value = JSON.stringify(`$ship numpy ${above}.${name} ${data.length} float64[${items.length}]`);
    }
    members.push(`${JSON.stringify(name)}:${value}`);
  }
  return [Buffer.from(`{${members.join(",")}}`), parts, blobs];
}

function shown(value) {
  if (Array.isArray(value)) return `[${value.map(shown).join(",")}]`;
  if (value && typeof value === "object") {
    return `{${Object.entries(value).map(([key, it]) => `${JSON.stringify(key)}:${shown(it)}`).join(",")}}`;
  }
  return typeof value === "string" ? JSON.stringify(value) : Object.is(value, -0) ? "-0.0" : String(value);
}

// What a program does.

// A place such as `arm.joints.0`: names of letters, digits and the like, and indexes.
function placeOf(text) {
  check(/^[^[\]{}"'\\~%*?^\s]+$/.test(text) && !text.split(".").includes(""), `${text} is not like arm.joints.0`);
  const [key, ...path] = text.split(".").map((it, at) => (at && /^\d+$/.test(it) ? Number(it) : it));
  const suffix = path.map((it) => (typeof it === "number" ? `[${it}]` : `.${it}`)).join("");
  return { text, key, path, suffix, tag: `{${key}}` };
}

// Return a list of the value with its arrays, all of one instant; an empty one if nothing is stored there.
async function read(server, place) {
  const jsonpath = `$${place.path.map((it) => `[${JSON.stringify(it)}]`).join("")}`;
  for (let attempt = 0; attempt < 100; attempt++) {
    await server.send("WATCH", place.key);
    const text = await (server.hasJson ? server.send("JSON.GET", place.key, jsonpath) : server.send("GET", place.key));
    check(text === null || server.hasJson || text[0] === 32, `${place.key} is a key of another program`);
    let holder = text === null ? [] : [parsed(text.toString())];
    for (const step of server.hasJson ? [0] : place.path) {
      const at = holder[0];
      holder = at && typeof at === "object" && Object.hasOwn(at, step) ? [at[step]] : [];
    }
    const found = placeholders(holder, place.text);
    await server.send("MULTI");
    for (const [, , suffix] of found) await server.send("GET", place.tag + suffix);
    const blobs = await server.send("EXEC"); // null if the document was written since: each write of an array writes it
    if (blobs !== null) return holder.length ? [filled(holder, found, blobs, place.key)] : [];
  }
  throw new Failure(`${place.text} was written all the time while it was read`);
}

// Replace a top-level key and notify its subscribers, in one transaction. Again if another client was faster.
async function publish(server, place, words) {
  check(!place.path.length, "publish a whole top-level key, such as arm");
  const [text, parts, blobs] = encoded(words, ""), { key, tag } = place;
  const stamp = [newId(6), 1]; // a program that publishes more counts on for each key
  const value = Buffer.concat([text, ...blobs]), isSmall = value.length <= IN_NOTICE;
  const what = isSmall ? ["set", text.length, parts] : ["look", value.length, []];
  const head = Buffer.from(`${JSON.stringify([1, ...stamp, Date.now() / 1000, [], ...what])}\n`);
  for (let attempt = 0; attempt < 100; attempt++) {
    await server.send("WATCH", key, `${tag}:ships`, `${tag}:lease`);
    const kind = await server.send("TYPE", key);
    const isText = !server.hasJson && kind === "string" && String(await server.send("GETRANGE", key, 0, 0)) === " ";
    check(kind === "none" || (server.hasJson && kind === "ReJSON-RL") || isText, `${key} is a key of another program`);
    check((await server.send("GET", `${tag}:lease`)) === null, `${key} is owned by another program`);
    const old = (await server.send("SMEMBERS", `${tag}:ships`)).map((it) => tag + it);
    await server.send("MULTI");
    await server.send("UNLINK", `${tag}:ships`, ...old, ...parts.map((it) => tag + it[1]));
    for (const [index, [, suffix]] of parts.entries()) {
      await server.send("SET", tag + suffix, blobs[index]);
      await server.send("SADD", `${tag}:ships`, suffix);
    }
    await (server.hasJson ? server.send("JSON.SET", key, "$", text) : server.send("SET", key, ` ${text}`, "KEEPTTL"));
    await server.send("SET", `${tag}:last`, stamp.join(" "), "EX", 60);
    await server.send("PUBLISH", `${tag}:notices`, isSmall ? Buffer.concat([head, value]) : head);
    const replies = await server.send("EXEC");
    for (const it of replies ?? []) if (it instanceof Failure) throw it;
    if (replies !== null) return;
  }
  throw new Failure(`${key} was written all the time by another client`);
}

// Return the line of a notice (8 fields) or of a message (9), and the bytes behind it.
function received(payload, fields, place) {
  const end = payload.indexOf("\n"), line = JSON.parse(payload.toString("utf8", 0, Math.max(end, 0)));
  check(Array.isArray(line) && line.length >= fields, `${place.text}: a message is not of REEM`);
  const isNotice = typeof line[1] === "string" && line[2] > 0 && ["set", "look", "delete"].includes(line[5]);
  check(fields === 9 || isNotice, `${place.text}: a notice has no publisher, number or kind`);
  check(line[0] === 1, `${place.text}: a message has version ${JSON.stringify(line[0])}; this client knows 1`);
  return [line, payload.subarray(end + 1)];
}

// Return the value of a message: a text of so many bytes, and its arrays.
function carried(data, size, parts, place) {
  const blobs = new Map();
  let start = size;
  parts.forEach(([, suffix, length]) => {
    blobs.set(suffix, data.subarray(start, start + length));
    start += length;
  });
  check(start === data.length, `${place.text}: a message has another size than it says`);
  const holder = [parsed(String(data.subarray(0, size)))];
  const found = placeholders(holder, place.text);
  return filled(holder, found, found.map((it) => blobs.get(it[2])), place.key);
}

// Print the value, then each update. After a gap, and if a notice has no value, print the value again.
async function watch(server, place, most) {
  const known = new Map(), channel = `${place.tag}:notices`, noted = (note) => String(note).split(" ");
  // Return how many updates of a publisher are missing before this one; NaN if the number goes back.
  const count = (publisher, number) => {
    const last = known.get(publisher) ?? number - 1;
    if (known.size > 1000) known.clear(); // most have ended
    known.set(publisher, number);
    return number > last ? number - last - 1 : NaN;
  };
  const print = (kind, lost, path, value) => console.log(shown({ kind, lost: isNaN(lost) ? null : lost, path, value }));
  let lost = 0, note = null, stale = true, probe = now() + 1;
  check(!place.path.length, "watch a whole top-level key, such as arm");
  await server.send("SUBSCRIBE", channel);
  const first = await server.send("GET", `${place.tag}:last`);
  if (first !== null) count(noted(first)[0], Number(noted(first)[1]));
  while (most > 0) {
    if (stale) {
      const [value = null] = await read(server, place);
      for (const payload of server.messages.splice(0)) { // what arrived before the reply is in it
        const [line] = received(payload, 8, place);
        lost += count(line[1], line[2]);
      }
      print("read", lost, [], value);
      [lost, note, stale, most] = [0, null, false, most - 1];
      continue;
    }
    const payload = await server.wait(probe - now());
    if (payload !== null) {
      const [line, data] = received(payload, 8, place);
      lost = count(line[1], line[2]);
      if (lost !== 0 || line[5] === "look") stale = true;
      else {
        print(line[5], 0, line[4], line[5] === "set" ? carried(data, line[6], line[7], place) : null);
        most -= 1;
      }
    }
    if (now() >= probe) { // the note names the last update: it must have arrived before the note
      note = await server.send("GET", `${place.tag}:last`);
      probe = now() + 1;
    }
    if (note !== null && !server.messages.length) {
      const [publisher, number] = noted(note);
      if ((known.get(publisher) ?? 0) < Number(number)) {
        known.set(publisher, Number(number));
        [stale, lost] = [true, NaN];
      }
      note = null;
    }
  }
}

// Return the answer of one server of a service. Only a request that was not begun goes to another server.
async function call(server, place, words, seconds = 10) {
  const me = newId(8), number = newId(8), end = now() + seconds, [text, parts, blobs] = encoded(words, place.suffix);
  const value = Buffer.concat([text, ...blobs]), pattern = place.suffix.replace(/[[\]]/g, "\\$&"); // special in patterns
  check(value.length <= IN_REQUEST, `this client sends up to ${IN_REQUEST} bytes of arguments`);
  await server.send("SUBSCRIBE", `${place.tag}:answers@${me}`);
  const channels = await server.send("PUBSUB", "CHANNELS", `${place.tag}${pattern}:serve@${"?".repeat(16)}`);
  for (const channel of channels.map(String)) {
    const left = Math.max(end - now(), 0), request = [1, "call", number, me, left, ["", ""], "here", text.length, parts];
    const head = Buffer.from(`${JSON.stringify(request)}\n`);
    if (!(await server.send("PUBLISH", channel, Buffer.concat([head, value])))) continue; // it has ended
    let line, data;
    do {
      const payload = await server.wait(end - now());
      if (payload !== null) [line, data] = received(payload, 9, place);
      if (payload === null && now() >= end) {
        await server.send("PUBLISH", channel, `${JSON.stringify([1, "cancel", number, me, 0, [], "", 0, []])}\n`);
        throw new Failure(`${place.text}: no answer in time; the request may or may not have been handled`);
      }
    } while (line?.[2] !== number || line[3] !== channel.slice(-16));
    if (["busy", "closed"].includes(line[1])) continue;
    check(line[1] === "answer", `${place.text}: the service raised ${shown(line[5])}`);
    check(line[6] === "here", `${place.text}: the answer has over 64 KB, which this client does not read`);
    return carried(data, line[7], line[8], place);
  }
  throw new Failure(`${place.text}: no program serves this, or all are busy`);
}

async function main(url, action, text, ...words) {
  check(text !== undefined, "usage: node reem.mjs URL get|publish|watch|call PLACE [NAME=VALUE ... | COUNT]");
  check(["get", "publish", "watch", "call"].includes(action), `${action} is none of get, publish, watch and call`);
  const place = placeOf(text), server = await Connection.open(url);
  if (action === "publish") await publish(server, place, words);
  if (action === "watch") await watch(server, place, Number(words[0] ?? Infinity));
  if (action === "call") console.log(shown(await call(server, place, words)));
  if (action === "get") {
    const holder = await read(server, place);
    check(holder.length, `nothing is stored at ${text}`);
    console.log(shown(holder[0]));
  }
}

main(...process.argv.slice(2)).then(
  () => process.exit(0),
  (error) => { console.error(`error: ${error.message.replace(/\s+/g, " ")}`); process.exit(1); },
);
