// Submits sub-maps to a magic-slam server and reads loops, corrected poses and the map, printed as JSON.
//
//   client ADDRESS submit HEADER.json BLOB...    the header as proto3 JSON, its blobs' files in order
//   client ADDRESS loops SUBMAP                  SUBMAP: sessions/{s}/agents/{a}/submaps/{m}
//   client ADDRESS poses SESSION [AGENT]
//   client ADDRESS map SESSION FILE.ply          the newest merged map, or the preview before there is one
//
// `submit` fills in each blob's length and SHA-256. Sent again, the same sub-map gets its first answer.

#include <algorithm>
#include <chrono>
#include <cstdint>
#include <cstdio>
#include <fstream>
#include <iostream>
#include <iterator>
#include <memory>
#include <stdexcept>
#include <string>
#include <vector>

#include <google/protobuf/util/json_util.h>
#include <grpcpp/grpcpp.h>
#include <openssl/evp.h>
#include <openssl/sha.h>
#include <zlib.h>

#include "magicslam/v1/global_map_service.grpc.pb.h"
#include "magicslam/v1/mapping_service.grpc.pb.h"

namespace api = magicslam::v1;
using google::protobuf::Message;

namespace {

constexpr std::size_t kChunkBytes = 1 << 20;
constexpr std::chrono::seconds kDeadline{20};
constexpr std::chrono::seconds kUploadDeadline{300};
constexpr std::chrono::seconds kDownloadDeadline{600};

using Channel = std::shared_ptr<grpc::Channel>;
using Arguments = std::vector<std::string>;

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

std::string Submit(const Channel& channel, const Arguments& arguments) {
  const auto stub = api::MappingService::NewStub(channel);
  std::vector<std::string> blobs;
  for (std::size_t i = 1; i < arguments.size(); ++i) blobs.push_back(ReadFile(arguments[i]));
  const api::SubmapHeader header = ReadHeader(arguments.at(0), blobs);
  Register(*stub, header);

  grpc::ClientContext context;
  SetDeadline(context, kUploadDeadline);
  api::SubmitSubmapResponse answer;
  auto writer = stub->SubmitSubmap(&context, &answer);
  api::SubmitSubmapRequest first;
  *first.mutable_header() = header;
  bool open = writer->Write(first);
  for (std::size_t i = 0; open && i < blobs.size(); ++i) open = WriteBlob(*writer, i, blobs[i]);
  if (open) writer->WritesDone();
  Require(writer->Finish());
  return Json(answer);
}

std::string Loops(const Channel& channel, const Arguments& arguments) {
  api::QueryLoopsRequest request;
  request.set_submap(arguments.at(0));
  api::QueryLoopsResponse answer;
  grpc::ClientContext context;
  SetDeadline(context, kDeadline);
  Require(api::MappingService::NewStub(channel)->QueryLoops(&context, request, &answer));
  return Json(answer);
}

std::string Poses(const Channel& channel, const Arguments& arguments) {
  api::GetCorrectedPosesRequest request;
  request.set_session("sessions/" + arguments.at(0));
  if (arguments.size() > 1) request.set_agent(request.session() + "/agents/" + arguments[1]);
  api::GetCorrectedPosesResponse answer;
  grpc::ClientContext context;
  SetDeadline(context, kDeadline);
  Require(api::MappingService::NewStub(channel)->GetCorrectedPoses(&context, request, &answer));
  return Json(answer.snapshot());
}

// Writes the map's file as it comes. Nothing is left of a broken one.
std::string Map(const Channel& channel, const Arguments& arguments) {
  const std::string& path = arguments.at(1);
  api::GetGlobalMapRequest request;
  request.set_name("sessions/" + arguments[0]);
  request.set_format(api::MAP_FORMAT_PLY);
  const auto stub = api::GlobalMapService::NewStub(channel);
  grpc::ClientContext context;
  SetDeadline(context, kDownloadDeadline);
  auto reader = stub->GetGlobalMap(&context, request);
  api::GlobalMapHeader header;
  const std::unique_ptr<EVP_MD_CTX, decltype(&EVP_MD_CTX_free)> digest(EVP_MD_CTX_new(), EVP_MD_CTX_free);
  EVP_DigestInit_ex(digest.get(), EVP_sha256(), nullptr);
  std::ofstream file(path, std::ios::binary);
  bool whole = true;
  for (api::GetGlobalMapResponse message; whole && reader->Read(&message);) {
    if (message.has_header()) {
      header = message.header();
      continue;
    }
    const std::string& data = message.chunk().data();
    whole = Crc32(data) == message.chunk().crc32();
    EVP_DigestUpdate(digest.get(), data.data(), data.size());
    file.write(data.data(), static_cast<std::streamsize>(data.size()));
  }
  if (!whole) context.TryCancel();
  const grpc::Status status = reader->Finish();
  std::string found(SHA256_DIGEST_LENGTH, '\0');
  EVP_DigestFinal_ex(digest.get(), reinterpret_cast<unsigned char*>(found.data()), nullptr);
  file.close();
  if (whole && status.ok() && file && found == header.sha256()) return Json(header.map());
  std::remove(path.c_str());
  if (whole) Require(status);
  throw std::runtime_error(path + ": the map came damaged, or could not be written");
}

int Run(const Arguments& arguments) {
  const std::string command = arguments.size() > 2 ? arguments[1] : "";
  const auto action = command == "submit"  ? Submit
                      : command == "loops" ? Loops
                      : command == "poses" ? Poses
                      : command == "map"   ? Map
                                           : nullptr;
  const std::size_t least = command == "map" || command == "submit" ? 4 : 3;
  if (action == nullptr || arguments.size() < least) {
    std::cerr << "usage: client ADDRESS submit HEADER.json BLOB... | loops SUBMAP | "
                 "poses SESSION [AGENT] | map SESSION FILE\n";
    return 2;
  }
  const auto channel = grpc::CreateChannel(arguments[0], grpc::InsecureChannelCredentials());
  try {
    std::cout << action(channel, {arguments.begin() + 2, arguments.end()}) << "\n";
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
