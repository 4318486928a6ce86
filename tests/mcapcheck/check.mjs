// Reads a whole recording with @mcap/core, by its index and as a stream, and compares every checksum.
import { McapIndexedReader, McapStreamReader } from "@mcap/core";
import { FileHandleReadable } from "@mcap/nodejs";
import { loadDecompressHandlers } from "@mcap/support";
import { open, readFile } from "fs/promises";

const file = process.argv[2];
const decompressHandlers = await loadDecompressHandlers();

const handle = await open(file, "r");
const reader = await McapIndexedReader.Initialize({ readable: new FileHandleReadable(handle), decompressHandlers });
const topics = {};
let indexed = 0;
let last = 0n;
for await (const message of reader.readMessages({ validateCrcs: true })) {
  if (message.logTime < last) throw new Error(`message ${indexed} goes back in time`);
  last = message.logTime;
  indexed++;
  const { topic } = reader.channelsById.get(message.channelId);
  topics[topic] = (topics[topic] ?? 0) + 1;
}
await handle.close();

const stream = new McapStreamReader({ decompressHandlers, validateCrcs: true });
const data = await readFile(file);
let streamed = 0;
for (let at = 0; at < data.length; at += 1 << 24) {
  stream.append(data.subarray(at, at + (1 << 24)));
  for (let record; (record = stream.nextRecord()); ) if (record.type === "Message") streamed++;
}
if (!stream.done() || streamed !== indexed || BigInt(indexed) !== reader.statistics.messageCount) {
  throw new Error(`${indexed} by the index, ${streamed} in the stream, ${reader.statistics.messageCount} in the statistics`);
}
console.log(JSON.stringify({ messages: indexed, chunks: reader.chunkIndexes.length, topics }));
