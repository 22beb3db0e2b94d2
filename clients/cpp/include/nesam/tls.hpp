#pragma once

#include <string>

#include <nesam/error.hpp>

namespace nesam {

/// How a connection is encrypted and who this client is; all in PEM.
struct Tls {
  /// Authority that has signed the server's certificate.
  std::string authority;
  /// Certificate of this client, whose subject alternative name says who it is; empty = none.
  std::string certificate;
  /// Its private key.
  std::string key;
  /// Name that the server's certificate must have, if that is not the host of the target; empty = the host of the target.
  std::string server_name;

  /// Reads the three files; an empty path leaves its part empty. NOT_FOUND names a file that cannot be read.
  static Result<Tls> from_files(const std::string& authority, const std::string& certificate = {}, const std::string& key = {});
};

}  // namespace nesam
