#pragma once

#include <chrono>
#include <cstdint>
#include <optional>
#include <string>

#include <google/protobuf/any.pb.h>
#include <google/protobuf/duration.pb.h>
#include <google/protobuf/empty.pb.h>
#include <google/protobuf/message.h>
#include <google/protobuf/unknown_field_set.h>

namespace nesam::detail {

/// What google.rpc.RetryInfo says in the details of a status (bytes of google.rpc.Status); nothing where it is not there, or they are none.
///
/// Debian has no package of google.rpc for C++, so the two messages are read by the numbers of their fields: Status.details = 3, RetryInfo.retry_delay = 1.
inline std::optional<std::chrono::nanoseconds> retry_after_of(const std::string& details) {
  using google::protobuf::UnknownField;
  google::protobuf::Empty status, retry;
  google::protobuf::Any detail;
  google::protobuf::Duration delay;
  if (!status.ParseFromString(details)) return std::nullopt;
  const auto& fields = status.GetReflection()->GetUnknownFields(status);
  for (int i = 0; i < fields.field_count(); ++i) {
    const UnknownField& field = fields.field(i);
    if (field.number() != 3 || field.type() != UnknownField::TYPE_LENGTH_DELIMITED || !detail.ParseFromString(field.length_delimited())) continue;
    if (detail.type_url() != "type.googleapis.com/google.rpc.RetryInfo" || !retry.ParseFromString(detail.value())) continue;
    const auto& told = retry.GetReflection()->GetUnknownFields(retry);
    for (int k = 0; k < told.field_count(); ++k) {
      if (told.field(k).number() != 1 || told.field(k).type() != UnknownField::TYPE_LENGTH_DELIMITED) continue;
      constexpr std::int64_t longest_s = 24 * 3600 * 365;
      if (!delay.ParseFromString(told.field(k).length_delimited()) || delay.seconds() < 0 || delay.seconds() > longest_s) continue;
      return std::chrono::seconds(delay.seconds()) + std::chrono::nanoseconds(delay.nanos());
    }
  }
  return std::nullopt;
}

}  // namespace nesam::detail
