// Goal: over TLS a client is who its certificate says. Method: a server with the fleet file of `deploy/config`, certificates in a folder.
//
// Usage: tls_test HOST:PORT FOLDER     FOLDER: ca.pem, other-ca.pem, truck-7.pem, truck-7.key; the server's certificate is for `localhost`.
// Exit code 0 when everything passed, 1 when something failed, 2 for wrong usage.

#include <nesam/nesam.hpp>

#include <chrono>
#include <cstdio>
#include <string>

namespace {

using namespace std::chrono_literals;

int failed = 0;

void check(bool holds, const std::string& what) {
  std::printf("%s %s\n", holds ? "ok     " : "FAILED ", what.c_str());
  failed += holds ? 0 : 1;
}

template <class T>
void check_code(const nesam::Result<T>& result, nesam::Code code, const std::string& what) {
  check(!result.ok() && result.error().code() == code, what + (result.ok() ? ": succeeded" : std::string(": ") + result.error().what()));
}

nesam::Client client(const std::string& target, nesam::Tls tls) {
  tls.server_name = "localhost";
  nesam::ClientOptions options;
  options.timeout = 20s;
  options.vehicle_id = "truck-7";
  options.tls = std::move(tls);
  return nesam::Client(target, options);
}

nesam::OpenOptions vehicle(const std::string& id) {
  nesam::OpenOptions options;
  options.vehicle_id = id;
  return options;
}

void run(const std::string& target, const std::string& folder) {
  const auto file = [&](const char* name) { return folder + "/" + name; };
  const nesam::Tls truck = nesam::Tls::from_files(file("ca.pem"), file("truck-7.pem"), file("truck-7.key")).value();
  nesam::Client known = client(target, truck);
  {
    auto session = known.open(vehicle("truck-7"));
    check(session.ok(), session.ok() ? "its own session" : session.error().what());
    if (session) {
      nesam::Measurement measurement;
      measurement.stamp_ns = 1'000'000'000;
      check(session->send(measurement).value().accepted(), "a measurement on the encrypted stream");
    }
  }
  check_code(known.open(vehicle("truck-8")), nesam::Code::permission_denied, "another vehicle's session");
  nesam::Tls nobody = truck;
  nobody.certificate.clear();
  nobody.key.clear();
  check_code(client(target, nobody).sessions(), nesam::Code::unavailable, "no certificate");
  check_code(client(target, nesam::Tls::from_files(file("other-ca.pem"), file("truck-7.pem"), file("truck-7.key")).value()).sessions(),
             nesam::Code::unavailable, "a server of another authority");
  check_code(nesam::Client(target).sessions(20s), nesam::Code::unavailable, "without TLS");
  const auto absent = nesam::Tls::from_files(file("ca.pem"), file("absent.pem"));
  check(!absent.ok() && absent.error().code() == nesam::Code::not_found && absent.error().field() == "certificate", "a file that is not there is named");
}

}  // namespace

int main(int argc, char** argv) {
  if (argc != 3) {
    std::fprintf(stderr, "usage: tls_test HOST:PORT FOLDER\n");
    return 2;
  }
  try {
    run(argv[1], argv[2]);
  } catch (const std::exception& error) {
    check(false, std::string("threw ") + error.what());
  }
  return failed == 0 ? 0 : 1;
}
