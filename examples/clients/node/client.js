// Submits sub-maps to a magic-slam server and reads loops, corrected poses and the map, printed as JSON.
//
//   node client.js ADDRESS submit HEADER.json BLOB...    the header as proto3 JSON, its blobs' files in order
//   node client.js ADDRESS poses SESSION [AGENT]     for example: node client.js localhost:50051 poses kitchen
//   node client.js ADDRESS loops SUBMAP              SUBMAP: sessions/{s}/agents/{a}/submaps/{m}
//   node client.js ADDRESS map SESSION FILE.ply      the newest merged map, or the preview before there is one
//
// It loads the .proto files at run time; nothing is generated. `submit` fills in each blob's length and
// SHA-256. Sent again, the same sub-map gets its first answer.

import { createHash } from "node:crypto";
import { open, readFile, rm } from "node:fs/promises";
import path from "node:path";
import process from "node:process";
import { fileURLToPath } from "node:url";

import grpc from "@grpc/grpc-js";
import protoLoader from "@grpc/proto-loader";

const PROTO_ROOT = path.resolve(path.dirname(fileURLToPath(import.meta.url)), "../../../proto");
const DEADLINE_MS = 20_000;
const UPLOAD_DEADLINE_MS = 300_000;
const DOWNLOAD_DEADLINE_MS = 600_000;
const CHUNK_BYTES = 1 << 20;

// Names stay as the .proto writes them; 64-bit numbers become strings, enums their names, and every
// field is there even where it was not sent (absent messages as null).
const definition = protoLoader.loadSync(
  ["magicslam/v1/mapping_service.proto", "magicslam/v1/global_map_service.proto"],
  {
    includeDirs: [PROTO_ROOT],
    keepCase: true,
    longs: String,
    enums: String,
    defaults: true,
  },
);
const { MappingService, GlobalMapService } = grpc.loadPackageDefinition(definition).magicslam.v1;

/** Calls a unary method with a deadline; resolves to the answer. */
function call(client, method, request) {
  return new Promise((resolve, reject) => {
    const deadline = Date.now() + DEADLINE_MS;
    client[method](request, { deadline }, (error, answer) =>
      error ? reject(error) : resolve(answer),
    );
  });
}

/** The newest corrected poses; world_from_anchor is metres and a unit quaternion, w first. */
async function poses(client, session, agent) {
  const request = {
    session: `sessions/${session}`,
    agent: agent ? `sessions/${session}/agents/${agent}` : "",
  };
  return (await call(client, "GetCorrectedPoses", request)).snapshot;
}

/** CRC-32 as zlib, gzip and PNG have it. */
function crc32(data) {
  let crc = 0xffffffff;
  for (const byte of data) crc = CRC_TABLE[(crc ^ byte) & 0xff] ^ (crc >>> 8);
  return (crc ^ 0xffffffff) >>> 0;
}
const CRC_TABLE = Uint32Array.from({ length: 256 }, (_, value) => {
  for (let bit = 0; bit < 8; bit += 1) value = value & 1 ? 0xedb88320 ^ (value >>> 1) : value >>> 1;
  return value;
});

/** Names of a JSON file (camelCase in proto3 JSON) as the .proto writes them. */
function protoNames(value) {
  if (Array.isArray(value)) return value.map(protoNames);
  if (value === null || typeof value !== "object") return value;
  const snake = (name) => name.replace(/[A-Z]/g, (letter) => `_${letter.toLowerCase()}`);
  return Object.fromEntries(Object.entries(value).map(([name, inner]) => [snake(name), protoNames(inner)]));
}

/** The messages of an upload: the header, then each blob in chunks. */
function* uploadMessages(header, blobs) {
  yield { header };
  for (const [blobIndex, blob] of blobs.entries()) {
    for (let offset = 0; offset < blob.length; offset += CHUNK_BYTES) {
      const data = blob.subarray(offset, offset + CHUNK_BYTES);
      yield { chunk: { blob_index: blobIndex, offset, data, crc32: crc32(data) } };
    }
  }
}

/** Registers the sub-map's agent and sends the sub-map; the answer means that it is on the server's disk. */
async function submit(client, headerFile, ...blobFiles) {
  const header = protoNames(JSON.parse(await readFile(headerFile, "utf8")));
  const blobs = await Promise.all(blobFiles.map((file) => readFile(file)));
  if (blobs.length !== header.blobs.length) {
    throw new Error(`${headerFile} lists ${header.blobs.length} blobs, ${blobs.length} files are given`);
  }
  for (const [index, blob] of blobs.entries()) {
    const sha256 = createHash("sha256").update(blob).digest();
    Object.assign(header.blobs[index], { length: blob.length, sha256 });
  }
  header.request_id ||= header.name;
  await call(client, "RegisterAgent", {
    agent: header.name.slice(0, header.name.lastIndexOf("/submaps/")),
    request_id: header.request_id,
    descriptor_model_id: header.image_descriptor.model_id,
    descriptor_dimension: header.image_descriptor.vector.length,
  });
  return new Promise((resolve, reject) => {
    const deadline = Date.now() + UPLOAD_DEADLINE_MS;
    const stream = client.SubmitSubmap({ deadline }, (error, answer) =>
      error ? reject(error) : resolve(answer),
    );
    const messages = uploadMessages(header, blobs);
    // Waits for the server where it is slower than the disk; ends early where it has refused.
    const write = () => {
      for (let next = messages.next(); !next.done; next = messages.next()) {
        if (stream.destroyed) return;
        if (!stream.write(next.value)) {
          stream.once("drain", write);
          return;
        }
      }
      stream.end();
    };
    write();
  });
}

/** The loop candidates of a stored sub-map with the verdict on each. */
async function loops(client, submap) {
  return call(client, "QueryLoops", { submap });
}

/** Writes the map's file as it comes; resolves to what the server says of it. Nothing is left of a broken one. */
async function map(client, session, path) {
  const maps = new GlobalMapService(client.getChannel().getTarget(), grpc.credentials.createInsecure());
  const request = { name: `sessions/${session}`, format: "MAP_FORMAT_PLY" };
  const stream = maps.GetGlobalMap(request, { deadline: Date.now() + DOWNLOAD_DEADLINE_MS });
  const file = await open(path, "w");
  const digest = createHash("sha256");
  let header = null;
  let written = 0;
  try {
    for await (const message of stream) {
      if (message.header) {
        header = message.header;
        continue;
      }
      const { data, crc32: expected } = message.chunk;
      if (crc32(data) !== expected) throw new Error(`the chunk at byte ${written} is damaged`);
      await file.write(data);
      digest.update(data);
      written += data.length;
    }
    if (header === null || !digest.digest().equals(header.sha256)) {
      throw new Error(`the map is damaged: ${written} of ${header?.length ?? 0} bytes came, or others`);
    }
  } catch (error) {
    await rm(path);
    throw error;
  } finally {
    await file.close();
    maps.close();
  }
  return { map: header.map, bytes: written, file: path };
}

const COMMANDS = { submit, poses, loops, map };
const LEAST = { submit: 2, poses: 1, loops: 1, map: 2 };

async function main([address, command, ...rest]) {
  if (!address || !(command in COMMANDS) || rest.length < LEAST[command]) {
    process.stderr.write(
      "usage: node client.js ADDRESS submit HEADER.json BLOB... | loops SUBMAP | poses SESSION [AGENT] | map SESSION FILE\n",
    );
    return 2;
  }
  const client = new MappingService(address, grpc.credentials.createInsecure());
  try {
    const answer = await COMMANDS[command](client, ...rest);
    process.stdout.write(`${JSON.stringify(answer, null, 2)}\n`);
    return 0;
  } catch (error) {
    const status = { error: { code: grpc.status[error.code] ?? "UNKNOWN", message: error.details ?? error.message } };
    process.stdout.write(`${JSON.stringify(status)}\n`);
    return 1;
  } finally {
    client.close();
  }
}

process.exitCode = await main(process.argv.slice(2));
