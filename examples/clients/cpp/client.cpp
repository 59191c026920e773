// Submits sub-maps to a magic-slam server and reads loops and corrected poses, printed as JSON.
//
//   client ADDRESS submit HEADER.json BLOB...    the header as proto3 JSON, its blobs' files in order
//   client ADDRESS loops SUBMAP                  SUBMAP: sessions/{s}/agents/{a}/submaps/{m}
//   client ADDRESS poses SESSION [AGENT]
//
// `submit` fills in each blob's length and SHA-256. Sent again, the same sub-map gets its first answer.

#include <algorithm>
#include <chrono>
#include <cstdint>
#include <fstream>
#include <iostream>
#include <iterator>
#include <memory>
#include <stdexcept>
#include <string>
#include <vector>

#include <google/protobuf/util/json_util.h>
#include <grpcpp/grpcpp.h>
#include <openssl/sha.h>
#include <zlib.h>

#include "magicslam/v1/mapping_service.grpc.pb.h"

namespace api = magicslam::v1;
using google::protobuf::Message;

namespace {

constexpr std::size_t kChunkBytes = 1 << 20;
constexpr std::chrono::seconds kDeadline{20};
constexpr std::chrono::seconds kUploadDeadline{300};

// A call that the server refused, or that never reached it.
struct Refused : std::runtime_error {
  explicit Refused(const grpc::Status& status)
      : std::runtime_error(status.error_message()), code(status.error_code()) {}
  grpc::StatusCode code;
};

void Require(const grpc::Status& status) {
  if (!status.ok()) throw Refused(status);
}

void SetDeadline(grpc::ClientContext& context, std::chrono::seconds timeout) {
  context.set_deadline(std::chrono::system_clock::now() + timeout);
}

std::string Json(const Message& message) {
  google::protobuf::util::JsonPrintOptions options;
  options.add_whitespace = true;
  options.always_print_primitive_fields = true;
  options.preserve_proto_field_names = true;
  std::string text;
  if (!google::protobuf::util::MessageToJsonString(message, &text, options).ok()) {
    throw std::runtime_error("the answer cannot be written as JSON");
  }
  return text;
}

std::string ReadFile(const std::string& path) {
  std::ifstream file(path, std::ios::binary);
  if (!file) throw std::runtime_error(path + ": cannot be read");
  return {std::istreambuf_iterator<char>(file), {}};
}

std::string Sha256(const std::string& data) {
  unsigned char digest[SHA256_DIGEST_LENGTH];
  SHA256(reinterpret_cast<const unsigned char*>(data.data()), data.size(), digest);
  return {reinterpret_cast<char*>(digest), sizeof(digest)};
}

std::uint32_t Crc32(const std::string& data) {
  return crc32(0, reinterpret_cast<const Bytef*>(data.data()), data.size());
}

// The header of a JSON file, with the blobs' lengths and digests as they are.
api::SubmapHeader ReadHeader(const std::string& path, const std::vector<std::string>& blobs) {
  api::SubmapHeader header;
  const auto parsed = google::protobuf::util::JsonStringToMessage(ReadFile(path), &header);
  if (!parsed.ok()) throw std::runtime_error(path + ": " + parsed.ToString());
  if (static_cast<std::size_t>(header.blobs_size()) != blobs.size()) {
    throw std::runtime_error(path + " lists " + std::to_string(header.blobs_size()) + " blobs, " +
                             std::to_string(blobs.size()) + " files are given");
  }
  for (std::size_t i = 0; i < blobs.size(); ++i) {
    header.mutable_blobs(i)->set_length(blobs[i].size());
    header.mutable_blobs(i)->set_sha256(Sha256(blobs[i]));
  }
  if (header.request_id().empty()) header.set_request_id(header.name());
  return header;
}

// Enters the session, which begins with its first agent; an agent that is back resumes.
void Register(api::MappingService::Stub& stub, const api::SubmapHeader& header) {
  api::RegisterAgentRequest request;
  request.set_agent(header.name().substr(0, header.name().rfind("/submaps/")));
  request.set_request_id(header.request_id());
  request.set_descriptor_model_id(header.image_descriptor().model_id());
  request.set_descriptor_dimension(header.image_descriptor().vector_size());
  api::RegisterAgentResponse answer;
  grpc::ClientContext context;
  SetDeadline(context, kDeadline);
  Require(stub.RegisterAgent(&context, request, &answer));
}

// The chunks of one blob, in order. False once the server has ended the stream.
bool WriteBlob(grpc::ClientWriter<api::SubmitSubmapRequest>& writer, std::uint32_t index,
               const std::string& blob) {
  for (std::size_t offset = 0; offset < blob.size(); offset += kChunkBytes) {
    api::SubmitSubmapRequest message;
    api::BlobChunk* chunk = message.mutable_chunk();
    chunk->set_blob_index(index);
    chunk->set_offset(offset);
    chunk->set_data(blob.substr(offset, kChunkBytes));
    chunk->set_crc32(Crc32(chunk->data()));
    if (!writer.Write(message)) return false;
  }
  return true;
}

std::string Submit(api::MappingService::Stub& stub, const std::vector<std::string>& arguments) {
  std::vector<std::string> blobs;
  for (std::size_t i = 1; i < arguments.size(); ++i) blobs.push_back(ReadFile(arguments[i]));
  const api::SubmapHeader header = ReadHeader(arguments.at(0), blobs);
  Register(stub, header);

  grpc::ClientContext context;
  SetDeadline(context, kUploadDeadline);
  api::SubmitSubmapResponse answer;
  auto writer = stub.SubmitSubmap(&context, &answer);
  api::SubmitSubmapRequest first;
  *first.mutable_header() = header;
  bool open = writer->Write(first);
  for (std::size_t i = 0; open && i < blobs.size(); ++i) open = WriteBlob(*writer, i, blobs[i]);
  if (open) writer->WritesDone();
  Require(writer->Finish());
  return Json(answer);
}

std::string Loops(api::MappingService::Stub& stub, const std::vector<std::string>& arguments) {
  api::QueryLoopsRequest request;
  request.set_submap(arguments.at(0));
  api::QueryLoopsResponse answer;
  grpc::ClientContext context;
  SetDeadline(context, kDeadline);
  Require(stub.QueryLoops(&context, request, &answer));
  return Json(answer);
}

std::string Poses(api::MappingService::Stub& stub, const std::vector<std::string>& arguments) {
  api::GetCorrectedPosesRequest request;
  request.set_session("sessions/" + arguments.at(0));
  if (arguments.size() > 1) request.set_agent(request.session() + "/agents/" + arguments[1]);
  api::GetCorrectedPosesResponse answer;
  grpc::ClientContext context;
  SetDeadline(context, kDeadline);
  Require(stub.GetCorrectedPoses(&context, request, &answer));
  return Json(answer.snapshot());
}

int Run(const std::vector<std::string>& arguments) {
  const std::string command = arguments.size() > 2 ? arguments[1] : "";
  const auto action = command == "submit"  ? Submit
                      : command == "loops" ? Loops
                      : command == "poses" ? Poses
                                           : nullptr;
  if (action == nullptr) {
    std::cerr << "usage: client ADDRESS submit HEADER.json BLOB... | loops SUBMAP | "
                 "poses SESSION [AGENT]\n";
    return 2;
  }
  const auto channel = grpc::CreateChannel(arguments[0], grpc::InsecureChannelCredentials());
  const auto stub = api::MappingService::NewStub(channel);
  try {
    std::cout << action(*stub, {arguments.begin() + 2, arguments.end()}) << "\n";
    return 0;
  } catch (const Refused& refused) {
    std::cerr << "refused with code " << refused.code << ": " << refused.what() << "\n";
  } catch (const std::exception& error) {
    std::cerr << error.what() << "\n";
  }
  return 1;
}

}  // namespace

int main(int count, char** values) { return Run({values + 1, values + count}); }
