// Goal: a vehicle that keeps what is not durable loses nothing when the server is killed, and a client finds it soon when it is back.
// Method: the real binary with a store, SIGKILL in the middle of a drive, a restart on the same store; the same drive without a crash must teach the same soil,
// bit for bit.
//
// Usage: durable_test BINARY FOLDER [arguments of nesam serve]     FOLDER: empty, for stores and logs. Exit codes: check.hpp.

#include <nesam/nesam.hpp>

#include <chrono>
#include <csignal>
#include <filesystem>
#include <future>
#include <optional>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "check.hpp"
#include "scenario.hpp"
#include "server.hpp"

namespace {

using namespace std::chrono_literals;

/// Where the tests run.
struct Place {
  std::string binary;
  std::string folder;
  std::vector<std::string> arguments;

  /// Arguments of a server that keeps a store of this name.
  std::vector<std::string> with_store(const std::string& name) const {
    std::vector<std::string> all = arguments;
    all.insert(all.end(), {"--store", folder + "/" + name});
    return all;
  }
};

nesam::Client connected(const Server& server) {
  nesam::ClientOptions options;
  options.timeout = 60s;
  nesam::Client client(server.address(), options);
  client.connect(30s).value();
  return client;
}

nesam::Session opened(nesam::Client& client, const std::string& name, const std::string& map_id = {}) {
  nesam::OpenOptions options;
  options.vehicle_id = name;
  options.map_id = map_id;
  return std::move(client.open(options).value());
}

/// A drive of 37 steps that the filter of the soil takes, driven by a session of its own; what it has learned.
nesam::SessionStatus reference_drive(nesam::Client& client, std::vector<nesam::Measurement>& drive) {
  nesam::Session session = driven(client, "reference", "hills");
  for (int step = 0; step < 5; ++step) drive.push_back(cruise(step, session.vehicle()));
  for (const nesam::Measurement& measurement : predicted_drive(session)) {
    drive.push_back(measurement);
    (void)session.send(measurement).value();
  }
  return session.status().value();
}

void service_a_killed_server_costs_nothing(const Place& place) {
  Server server(place.binary, place.folder, place.with_store("killed"));
  nesam::Client client = connected(server);
  client.upload_map(HillyMap().view("hills", 1)).value();
  std::vector<nesam::Measurement> drive;
  const nesam::SessionStatus reference = reference_drive(client, drive);
  check(reference.provenance.soil_epoch > 0, "the drive teaches something");

  nesam::Session session = opened(client, "truck", "hills");
  nesam::DurableStream stream = session.durable_measurements();
  constexpr std::size_t crash = 22;
  for (std::size_t i = 0; i < crash; ++i) {
    const auto answer = stream.send(drive[i]);
    if (!check_ok(answer, "before the crash")) return;
    check(answer->accepted() && answer->place == i + 1 && answer->durable_place <= i + 1, "accepted at its place");
    // A store commits at least every second.
    if (i == crash / 2) std::this_thread::sleep_for(1500ms);
  }
  server.stop(SIGKILL);
  const std::size_t pending = stream.pending().size();
  check(pending > 0 && pending < crash, "some are durable and some are not: " + std::to_string(pending));
  check(pending > 0 && stream.pending().back().stamp_ns == drive[crash - 1].stamp_ns, "the newest is kept");
  std::thread restarter([&] {
    std::this_thread::sleep_for(500ms);
    server.start();
  });
  for (std::size_t i = crash; i < drive.size(); ++i) check_ok(stream.send(drive[i]), "after the crash");
  restarter.join();
  check_ok(stream.flush(30s), "flush");
  check(stream.pending().empty(), "everything is durable");

  const auto status = session.status();
  if (!check_ok(status, "status")) return;
  check(status->accepted == drive.size() && status->durable_place == drive.size() && status->last_sequence == drive.size(), "nothing lost, nothing twice");
  check(status->state && status->state->position_m == drive.back().state.position_m, "the newest state");
  const auto& learned = status->soil_correction;
  check(learned.covariance && learned.covariance == reference.soil_correction.covariance, "the covariance of a drive without a crash, bit for bit");
  check(learned.delta.k_phi == reference.soil_correction.delta.k_phi && learned.delta.k_shear_m == reference.soil_correction.delta.k_shear_m, "so is the soil");
  check(status->provenance.soil_epoch == reference.provenance.soil_epoch, "after as many updates");
}

void service_streams_outlive_a_restart(const Place& place) {
  Server server(place.binary, place.folder, place.with_store("restarted"));
  nesam::Client client = connected(server);
  nesam::Session session = opened(client, "truck");
  const nesam::VehicleCard card = session.vehicle();
  nesam::DurableOptions impatient;
  impatient.reconnect = 300ms;
  impatient.pause = 50ms;
  nesam::DurableStream stream = session.durable_measurements(impatient);
  check_ok(session.send(cruise(0, card)), "over the stream of the session");
  check_ok(stream.send(cruise(1, card)), "over the durable one");
  check_ok(stream.flush(), "flush");
  // A server that stops ends the streams that rest on it: both go on over another connection.
  check(server.stop(SIGTERM) == 0, "the server stops cleanly");
  const auto begin = std::chrono::steady_clock::now();
  check_error(stream.send(cruise(2, card)), nesam::Code::unavailable, "", "nobody is there");
  check(std::chrono::steady_clock::now() - begin < 20s, "it gives up in time");
  check(stream.pending().size() == 1, "and keeps the measurement");
  check_error(stream.send(cruise(3, card)), nesam::Code::unavailable, "", "nobody is there yet");
  // A prediction that was asked for with a fallback comes all the same, from the newest measurement, though that was sent in vain, and says so.
  const auto controls = varied_controls(2, 4, card);
  nesam::PredictRequest request = request_of(controls, 2, 4);
  check_error(session.predict(request, 20s), nesam::Code::unavailable, "", "a prediction without one");
  request.fallback = nesam::KinematicFallback{card};
  const auto fallback = session.predict(request, 20s);
  check(fallback.ok() && fallback->computed_by == nesam::ComputedBy::kinematic_fallback && fallback->fallback_reason &&
            fallback->fallback_reason->code() == nesam::Code::unavailable && fallback->start.position_m == cruise(3, card).state.position_m,
        fallback.ok() ? "the fallback is marked" : fallback.error().what());
  server.start();
  check_ok(client.connect(30s), "the server is there again");
  check_ok(stream.flush(30s), "flush sends it");
  const auto answer = session.send(cruise(4, card));
  check(answer.ok() && answer->accepted() && answer->place == 5, answer.ok() ? "place 5" : answer.error().what());

  // Refused measurements are answered and not kept; a closed stream begins again; a session that is closed is not waited for.
  nesam::Measurement bad = cruise(5, card);
  bad.state.velocity_m_s[0] = nan_d;
  const auto refused = stream.send(bad);
  check(refused.ok() && refused->is<nesam::NotFinite>() && stream.pending().empty(), "not finite: not kept");
  stream.close();
  const auto again = stream.send(cruise(5, card));
  check(again.ok() && again->accepted() && again->place == 6 && stream.pending().size() == 1, "after close");
  check_ok(session.close(), "close");
  check_error(stream.flush(), nesam::Code::not_found, "session_id", "a closed session");
}

/// How a session is closed and opened again between two measurements of a durable stream.
enum class Anew {
  by_this_client,
  by_another_seen_closed,
  by_another_after_a_rest,
  by_another_at_once,
};

void service_a_session_that_began_anew_gets_everything_in_order(const Place& place) {
  const Server server(place.binary, place.folder, place.with_store("anew"));
  nesam::Client client = connected(server), other = connected(server);
  const struct {
    Anew way;
    const char* name;
    int before;
  } cases[] = {{Anew::by_this_client, "this-client", 8},
               {Anew::by_another_seen_closed, "seen-closed", 8},
               {Anew::by_another_after_a_rest, "after-a-rest", 8},
               {Anew::by_another_at_once, "at-once", 8},
               {Anew::by_another_at_once, "at-once-after-one", 1}};
  for (const auto& [way, name, before] : cases) {
    nesam::Session session = opened(client, name);
    const nesam::VehicleCard card = session.vehicle();
    nesam::DurableStream stream = session.durable_measurements();
    for (int step = 0; step < before; ++step) check_ok(stream.send(cruise(step, card)), name);
    int next = before;
    if (way == Anew::by_another_after_a_rest) std::this_thread::sleep_for(1100ms);
    nesam::Client& opener = way == Anew::by_this_client ? client : other;
    check_ok(opener.close(name), name);
    if (way == Anew::by_another_seen_closed) {
      check_error(stream.send(cruise(next++, card)), nesam::Code::not_found, "session_id", name);
      check(stream.pending().back().stamp_ns == cruise(before, card).stamp_ns, "what came meanwhile is kept");
      check_error(stream.flush(), nesam::Code::not_found, "session_id", name);
    }
    // Some may be known to be durable, in the session that was.
    const std::size_t kept = stream.pending().size();
    const nesam::Session again = opened(opener, name);
    const auto answer = stream.send(cruise(next, card));
    if (!check_ok(answer, name)) continue;
    const auto flushed = stream.flush(30s);
    const auto status = again.status();
    if (!check_ok(status, name)) continue;
    check(stream.pending().empty() && status->durable_place == status->accepted, "everything is durable");
    check(status->last_stamp_ns == cruise(next, card).stamp_ns, "the newest is the newest");
    check(answer->is<nesam::Duplicate>() == nullptr && answer->accepted(), std::string(name) + ": the newest is told what became of it");
    auto refused = stream.take_refused();
    check(status->accepted + refused.size() == kept + 1, std::string(name) + ": what was not taken is told");
    if (way == Anew::by_another_at_once && before > 3) {
      check_error(flushed, nesam::Code::data_loss, "", "what is behind the window");
      check(kept < 4 || !refused.empty(), "some are too old");
      for (std::size_t i = 0; i < refused.size(); ++i) {
        check(refused[i].answer.is<nesam::TooOld>() && refused[i].measurement.stamp_ns == refused[i].answer.stamp_ns, "which and why");
        check(i == 0 || refused[i].measurement.stamp_ns > refused[i - 1].measurement.stamp_ns, "oldest first");
      }
      check_ok(stream.flush(), "it is told until it was heard");
    } else {
      check_ok(flushed, name);
      check(refused.empty(), std::string(name) + ": all were taken");
    }
  }
}

void service_flush_notices_that_a_session_began_anew(const Place& place) {
  const Server server(place.binary, place.folder, place.with_store("flushed"));
  nesam::Client client = connected(server), other = connected(server);
  for (const bool is_newer : {false, true}) {
    nesam::OpenOptions options;
    options.vehicle_id = is_newer ? "newer" : "blank";
    nesam::Session session = std::move(client.open(options).value());
    nesam::DurableStream stream = session.durable_measurements();
    for (int step = 0; step < 8; ++step) check_ok(stream.send(cruise(step, session.vehicle())), "before");
    const std::size_t kept = stream.pending().size();
    // Over another connection it goes again, which says nothing of whether the session has it.
    if (is_newer) stream.close();
    check_ok(other.close(session.id()), "close");
    if (is_newer) options.initial = cruise(40, session.vehicle());
    const nesam::Session again = std::move(other.open(options).value());
    const auto flushed = stream.flush(30s);
    check(stream.pending().empty(), "nothing is kept");
    if (is_newer) {
      check_error(flushed, nesam::Code::data_loss, "", "a session that knows something newer");
      check(stream.take_refused().size() == kept && stream.take_refused().empty(), "all of it, once");
    } else {
      check_ok(flushed, "flush");
      check(again.status().value().accepted == kept && stream.take_refused().empty(), "all of it is there");
    }
  }
}

/// Time from when a server answers again after an outage to the first answer that a client gets which has asked at 20 Hz all the while; that of its destruction
/// while the server is away once more.
struct Return {
  std::chrono::duration<double> late{1e9};
  std::chrono::duration<double> ending{1e9};
};

Return back_after(const Place& place, const std::string& name, std::chrono::milliseconds outage) {
  using Clock = std::chrono::steady_clock;
  const std::string folder = place.folder + "/" + name;
  std::filesystem::create_directory(folder);
  Server server(place.binary, folder, place.arguments);
  Return measured;
  std::optional<nesam::Client> client(connected(server));
  std::thread outside([&] {
    server.stop(SIGKILL);
    std::this_thread::sleep_for(outage);
    server.start();
  });
  // Not before the server is away: what it answered before is no answer.
  while (client->sessions(45ms)) std::this_thread::sleep_for(1ms);
  std::optional<Clock::time_point> first;
  for (const auto until = Clock::now() + outage + 30s; !first && Clock::now() < until;) {
    const auto next = Clock::now() + 50ms;
    if (client->sessions(45ms)) first = Clock::now();
    std::this_thread::sleep_until(next);
  }
  outside.join();
  if (first) measured.late = *first - server.ready_since();
  server.stop(SIGKILL);
  while (client->sessions(45ms)) std::this_thread::sleep_for(1ms);
  const auto begin = Clock::now();
  client.reset();
  measured.ending = Clock::now() - begin;
  return measured;
}

void service_a_server_that_comes_back_is_found(const Place& place) {
  auto shorter = std::async(std::launch::async, [&] { return back_after(place, "away-3", 3s); });
  const Return longer = back_after(place, "away-8", 8s);
  for (const Return& measured : {shorter.get(), longer}) {
    std::printf("  found after %.2f s, destroyed in %.3f s\n", measured.late.count(), measured.ending.count());
    check(measured.late < 2500ms, "found " + std::to_string(measured.late.count()) + " s after it was ready");
    check(measured.ending < 500ms, "destroyed in " + std::to_string(measured.ending.count()) + " s");
  }
}

void service_without_a_store_nothing_is_durable(const Place& place) {
  const Server server(place.binary, place.folder, place.arguments);
  nesam::Client client = connected(server);
  nesam::Session session = opened(client, "truck");
  nesam::DurableOptions options;
  options.pending_max = 3;
  nesam::DurableStream stream = session.durable_measurements(options);
  for (int step = 0; step < 3; ++step) check_ok(stream.send(cruise(step, session.vehicle())), "three are kept");
  check_error(stream.send(cruise(3, session.vehicle())), nesam::Code::resource_exhausted, "pending_max", "the fourth");
  check_error(stream.flush(200ms), nesam::Code::deadline_exceeded, "", "nothing becomes durable");
  check(stream.pending().size() == 3 && session.status().value().accepted == 3, "three are accepted and kept");
}

void service_a_new_boot_or_a_clock_that_is_set_loses_nothing(const Place& place) {
  const Server server(place.binary, place.folder, place.arguments);
  nesam::Client client = connected(server);
  for (const bool is_boot : {true, false}) {
    nesam::Session session = opened(client, is_boot ? "boot" : "clock");
    nesam::DurableStream stream = session.durable_measurements();
    const auto measurement = [&](int step) {
      nesam::Measurement one = cruise(step, session.vehicle());
      if (is_boot) one.boot_id = step < 10 ? 7 : 8;
      if (!is_boot && step >= 10) one.stamp_ns += std::chrono::nanoseconds(1h).count();
      return one;
    };
    for (int step = 0; step < 20; ++step) check_ok(stream.send(measurement(step)), "first over one connection");
    // Of a clock that was set the first measurement is taken for an error.
    std::size_t accepted = is_boot ? 20 : 19;
    check(stream.pending().size() == accepted && session.status().value().accepted == accepted, "all that was accepted is kept");
    for (int step = 20; step < 22; ++step) {
      stream.close();
      const auto answer = stream.send(measurement(step));
      check(answer.ok() && answer->accepted() && answer->place == ++accepted, answer.ok() ? "place" : answer.error().what());
      check(stream.pending().size() == accepted && stream.take_refused().empty(), std::to_string(stream.pending().size()) + " kept over another connection");
    }
    check(session.status().value().accepted == accepted, "nothing twice");
  }
}

}  // namespace

int main(int argc, char** argv) {
  if (argc < 3) {
    std::fprintf(stderr, "usage: durable_test BINARY FOLDER [arguments of nesam serve]\n");
    return 2;
  }
  const Place place{argv[1], argv[2], {argv + 3, argv + argc}};
  run("service_a_killed_server_costs_nothing", [&] { service_a_killed_server_costs_nothing(place); });
  run("service_streams_outlive_a_restart", [&] { service_streams_outlive_a_restart(place); });
  run("service_a_session_that_began_anew_gets_everything_in_order", [&] { service_a_session_that_began_anew_gets_everything_in_order(place); });
  run("service_flush_notices_that_a_session_began_anew", [&] { service_flush_notices_that_a_session_began_anew(place); });
  run("service_a_server_that_comes_back_is_found", [&] { service_a_server_that_comes_back_is_found(place); });
  run("service_a_new_boot_or_a_clock_that_is_set_loses_nothing", [&] { service_a_new_boot_or_a_clock_that_is_set_loses_nothing(place); });
  run("service_without_a_store_nothing_is_durable", [&] { service_without_a_store_nothing_is_durable(place); });
  std::printf("%d passed, %d failed\n", passed, failed);
  return failed == 0 ? 0 : 1;
}
