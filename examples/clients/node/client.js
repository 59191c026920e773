// Reads corrected poses and loop candidates from a magic-slam server and prints them as JSON.
//
//   node client.js ADDRESS poses SESSION [AGENT]     for example: node client.js localhost:50051 poses kitchen
//   node client.js ADDRESS loops SUBMAP              SUBMAP: sessions/{s}/agents/{a}/submaps/{m}
//
// It loads the .proto files at run time; nothing is generated.

import path from "node:path";
import process from "node:process";
import { fileURLToPath } from "node:url";

import grpc from "@grpc/grpc-js";
import protoLoader from "@grpc/proto-loader";

const PROTO_ROOT = path.resolve(path.dirname(fileURLToPath(import.meta.url)), "../../../proto");
const DEADLINE_MS = 20_000;

// Names stay as the .proto writes them; 64-bit numbers become strings, enums their names, and every
// field is there even where it was not sent (absent messages as null).
const definition = protoLoader.loadSync("magicslam/v1/mapping_service.proto", {
  includeDirs: [PROTO_ROOT],
  keepCase: true,
  longs: String,
  enums: String,
  defaults: true,
});
const { MappingService } = grpc.loadPackageDefinition(definition).magicslam.v1;

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

/** The loop candidates of a stored sub-map with the verdict on each. */
async function loops(client, submap) {
  return call(client, "QueryLoops", { submap });
}

const COMMANDS = { poses, loops };

async function main([address, command, ...rest]) {
  if (!address || !(command in COMMANDS) || rest.length === 0) {
    process.stderr.write("usage: node client.js ADDRESS poses SESSION [AGENT] | loops SUBMAP\n");
    return 2;
  }
  const client = new MappingService(address, grpc.credentials.createInsecure());
  try {
    const answer = await COMMANDS[command](client, ...rest);
    process.stdout.write(`${JSON.stringify(answer, null, 2)}\n`);
    return 0;
  } catch (error) {
    const status = { error: { code: grpc.status[error.code], message: error.details ?? error.message } };
    process.stdout.write(`${JSON.stringify(status)}\n`);
    return 1;
  } finally {
    client.close();
  }
}

process.exitCode = await main(process.argv.slice(2));
