// Goal: predictions that start at an instant start there, and 16-bit replies are the 32-bit ones rounded.
// Method: the state rolled forward against the same commands sent as candidates, bit for bit; half against whole with the tolerance that eleven significant
// bits leave; the same over single calls and streams.
//
// Usage and exit codes: check.hpp.

#include <nesam/nesam.hpp>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <future>
#include <limits>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "../src/half.hpp"
#include "../src/retry_after.hpp"
#include "check.hpp"
#include "scenario.hpp"

namespace {

using namespace std::chrono_literals;

void published_halves_of_ieee_754() {
  const std::vector<std::pair<std::uint16_t, float>> table = {
      {0x3c00, 1.0F}, {0xc000, -2.0F}, {0x7bff, 65504.0F}, {0x0400, 6.103515625e-5F}, {0x03ff, 6.097555160522461e-5F}, {0x0001, 5.960464477539063e-8F},
      {0x3555, 0.333251953125F}, {0x0000, 0.0F}, {0x7c00, std::numeric_limits<float>::infinity()}, {0xfc00, -std::numeric_limits<float>::infinity()}};
  for (const auto& [bits, value] : table) check(nesam::detail::from_half(bits) == value, std::to_string(bits) + " is " + std::to_string(value));
  check(std::isnan(nesam::detail::from_half(0x7e00)) && std::signbit(nesam::detail::from_half(0x8000)), "not a number, and minus zero");
  const auto two = nesam::detail::unpack_half(std::string("\x00\x3c\x00\xc0\x01", 5));
  check(two == std::vector<float>{1.0F, -2.0F}, "little-endian; a left-over byte is ignored");
}

void published_retry_info_of_google_rpc() {
  // Status{code: 8, details: Any{"type.googleapis.com/google.rpc.RetryInfo", RetryInfo{retry_delay: 1.5 s}}} as protoc encodes it.
  const std::string url = "type.googleapis.com/google.rpc.RetryInfo", delay("\x0a\x08\x08\x01\x10\x80\xca\xb5\xee\x01", 10);
  const std::string any = "\x0a" + std::string(1, static_cast<char>(url.size())) + url + "\x12" + std::string(1, static_cast<char>(delay.size())) + delay;
  const std::string status = "\x08\x08\x1a" + std::string(1, static_cast<char>(any.size())) + any;
  check(nesam::detail::retry_after_of(status) == std::chrono::nanoseconds(1500ms), "a second and a half");
  check(!nesam::detail::retry_after_of("") && !nesam::detail::retry_after_of("\xff\xff"), "nothing is said");
  for (std::size_t cut = 1; cut < status.size(); ++cut) nesam::detail::retry_after_of(status.substr(0, cut));
}

/// A service that is asked for more than it can compute in time says when it has room.
void service_who_is_overloaded_is_told_when_to_come_back(const nesam::Session& session) {
  constexpr std::size_t samples = 2048, horizon = 32;
  std::vector<float> controls(2 * samples * horizon, 1.0F);
  for (std::size_t i = 1; i < controls.size(); i += 2) controls[i] = 0.0F;
  for (int attempt = 0; attempt < 50; ++attempt) {
    // Beside another one: alone it would be begun, or refused as one that never is in time.
    auto other = std::async(std::launch::async, [&] { return session.predict(request_of(controls, samples, horizon), 5s); });
    std::this_thread::sleep_for(10ms);
    auto refused = session.predict(request_of(controls, samples, horizon), 20ms);
    other.wait();
    if (refused || refused.error().code() != nesam::Code::resource_exhausted) continue;
    const auto pause = refused.error().retry_after();
    check(pause && *pause > 0ns && *pause < 60s, "the time to wait is told");
    return;
  }
  check(false, "50 predictions of 2048 candidates in 20 ms beside another one: none was refused for the load");
}

/// Checks that `half` is `whole` rounded to eleven significant bits: 4 mm for positions within 16 m of the start, 2^-11 of other numbers.
void check_rounded(const nesam::Prediction& half, const nesam::Prediction& whole, const std::string& what) {
  const auto rounded = half.states(), exact = whole.states();
  check(rounded.shape() == exact.shape() && half.channels == whole.channels && rounded.fits(), what + ": shape");
  if (rounded.shape() != exact.shape()) return;
  double farthest_m = 0.0, largest = 0.0;
  bool differ = false;
  for (std::size_t i = 0; i < exact.values().size(); ++i) {
    const double apart = std::abs(static_cast<double>(rounded.values()[i]) - exact.values()[i]);
    std::size_t channel = 0;
    for (std::size_t column = i % exact.channels(); (whole.channels >> channel & 1) == 0 || column-- > 0;) ++channel;
    differ = differ || apart > 0.0;
    if (channel < 3) {
      farthest_m = std::max(farthest_m, apart);
    } else {
      // The smallest normal number is 2^-14: below it the steps are 2^-24.
      largest = std::max(largest, apart / std::max(std::abs(static_cast<double>(exact.values()[i])), 0x1p-13));
    }
  }
  check(differ && farthest_m <= 0.004 && largest <= 0x1p-11, what + ": " + std::to_string(farthest_m) + " m and " + std::to_string(largest) + " apart");
}

void service_half_precision_is_rounding_only(const nesam::Session& session) {
  constexpr std::size_t samples = 3, horizon = 32;
  const auto controls = varied_controls(samples, horizon, session.vehicle());
  nesam::PredictRequest request = request_of(controls, samples, horizon);
  request.wheel_sinkage = true;
  const auto whole = predicted(session, request);
  request.half = true;
  const auto half = predicted(session, request);
  if (!check_ok(whole, "whole") || !check_ok(half, "half")) return;
  check_rounded(*half, *whole, "all channels");
  check(half->validity == whole->validity && half->start.position_m == whole->start.position_m, "validity and start are the same");
  const auto sinkage_m = half->sinkage_m(), exact_m = whole->sinkage_m();
  bool near = sinkage_m.fits() && sinkage_m.shape() == exact_m.shape();
  for (std::size_t i = 0; near && i < exact_m.values().size(); ++i) {
    near = std::abs(sinkage_m.values()[i] - exact_m.values()[i]) <= 1e-3F * exact_m.values()[i] + 1e-7F;
  }
  check(near, "sinkage");

  // Offsets belong to the channels that are there, far from the origin too, and extras stay as they are.
  request.channels = nesam::bit(nesam::Channel::y) | nesam::bit(nesam::Channel::z) | nesam::bit(nesam::Channel::vx);
  request.stride = 3;
  request.start = whole->start;
  request.start->position_m[1] = -12.25;
  request.extras.risk = true;
  const auto some = predicted(session, request);
  request.half = false;
  const auto exact = predicted(session, request);
  if (!check_ok(some, "three channels") || !check_ok(exact, "the same, whole")) return;
  check_rounded(*some, *exact, "three channels");
  check(equal_bits(some->extras.wheel_load_n.values(), exact->extras.wheel_load_n.values()), "loads have all their bits");
}

void service_half_precision_of_what_the_service_draws(const nesam::Session& session) {
  constexpr std::size_t horizon = 16;
  const auto nominal = varied_controls(1, horizon, session.vehicle());
  const std::vector<float> path = {-5.0F, 0.0F, 15.0F, 0.0F};
  nesam::PredictRequest request;
  request.drawing = nesam::CandidateDrawing{24, nesam::Span<const float>(nominal), 0.5, 0.1, 0.8, 7};
  request.cost = nesam::PathCost{};
  request.cost->path_m = nesam::Span<const float>(path);
  request.cost->best = 3;
  const auto whole = predicted(session, request);
  request.half = true;
  const auto half = predicted(session, request);
  if (!check_ok(whole, "whole") || !check_ok(half, "half")) return;
  check_rounded(*half, *whole, "the best");
  check(half->best == whole->best && equal_bits(half->costs, whole->costs) && equal_bits(half->drawn_storage, whole->drawn_storage), "ranking and commands");
}

/// What the vehicle was sent in the three steps after the newest measurement, 0.1 s apart.
std::vector<nesam::SentCommand> sent_commands(std::int64_t newest_ns) {
  std::vector<nesam::SentCommand> sent;
  for (int i = 1; i <= 3; ++i) sent.push_back({newest_ns + i * grid_ns, {1.5, 0.05 * i}});
  return sent;
}

void service_a_prediction_from_now_rolls_forward_with_what_was_sent(const nesam::Session& session) {
  constexpr std::size_t samples = 2, horizon = 5, ahead = 4;
  const nesam::Measurement newest = cruise(4, session.vehicle());
  const auto sent = sent_commands(newest.stamp_ns);
  const auto controls = varied_controls(samples, horizon, session.vehicle());
  nesam::PredictRequest request = request_of(controls, samples, horizon);
  request.start_stamp_ns = newest.stamp_ns + static_cast<std::int64_t>(ahead) * grid_ns;
  request.sent = nesam::Span<const nesam::SentCommand>(sent);
  const auto now = predicted(session, request);
  if (!check_ok(now, "from now")) return;
  check(now->rolled_forward_steps == ahead && now->start_stamp_ns == request.start_stamp_ns, "the start is told");

  // By hand: the measured command until the first that was sent, then those, then the candidates.
  std::vector<float> by_hand;
  for (std::size_t n = 0; n < samples; ++n) {
    const auto add = [&](const nesam::Control& command) {
      by_hand.push_back(static_cast<float>(command.speed_m_s));
      by_hand.push_back(static_cast<float>(command.second));
    };
    add(newest.command);
    for (const nesam::SentCommand& command : sent) add(command.command);
    const auto candidate = request.controls.sample(n);
    by_hand.insert(by_hand.end(), candidate.begin(), candidate.end());
  }
  const auto longer = predicted(session, request_of(by_hand, samples, ahead + horizon));
  if (!check_ok(longer, "by hand")) return;
  check(longer->rolled_forward_steps == 0 && longer->start_stamp_ns == newest.stamp_ns, "without an instant the newest measurement is the start");
  for (std::size_t n = 0; n < samples; ++n) {
    const std::string row = "row " + std::to_string(n);
    check(equal_bits(now->states().sample(n), longer->states().sample(n).subspan(12 * ahead, 12 * horizon)), row + " has the bits of the longer one");
  }
  check(now->start.position_m[0] == static_cast<double>(longer->states()(0, ahead - 1, 0)), "it starts where the steps before end");

  auto stream = session.predictions();
  if (!check_ok(stream, "stream")) return;
  request.half = true;
  check_ok(stream->send(request), "asked in a stream");
  auto streamed = stream->receive(60s);
  if (!check_ok(streamed, "answered") || !check_ok(streamed->prediction, "with a prediction")) return;
  check(streamed->prediction->rolled_forward_steps == ahead, "rolled forward in a stream");
  check_rounded(*streamed->prediction, *now, "and in 16 bits");
}

void service_bad_instants_are_refused(const nesam::Session& session) {
  constexpr std::size_t horizon = 30;
  constexpr auto invalid = nesam::Code::invalid_argument;
  const std::int64_t newest_ns = cruise(4, session.vehicle()).stamp_ns;
  auto sent = sent_commands(newest_ns);
  const auto controls = varied_controls(1, horizon, session.vehicle());
  nesam::PredictRequest request = request_of(controls, 1, horizon);
  request.start_stamp_ns = newest_ns + 4 * grid_ns;
  check_error(session.predict(request), nesam::Code::failed_precondition, "start_stamp_ns", "34 positions");
  request.start_stamp_ns = newest_ns - 40 * grid_ns;
  check_error(session.predict(request), invalid, "start_stamp_ns", "before the history");
  request.start_stamp_ns = newest_ns;
  check_ok(predicted(session, request), "the newest step");
  std::swap(sent[1], sent[2]);
  request.sent = nesam::Span<const nesam::SentCommand>(sent);
  check_error(session.predict(request), invalid, "sent[2].stamp_ns", "not by ascending stamp");
  std::swap(sent[1], sent[2]);
  sent[1].command.second = nan_d;
  check_error(session.predict(request), invalid, "sent[1].command.second", "a command that is NaN");
  sent[1].command.second = 0.0;
  request.start = nesam::VehicleState{};
  check_error(session.predict(request), invalid, "start", "an instant and a start");
}

void run_all(nesam::Client& client) {
  run("published_halves_of_ieee_754", published_halves_of_ieee_754);
  run("published_retry_info_of_google_rpc", published_retry_info_of_google_rpc);
  const HillyMap hills;
  const std::string map_id = unique("hills");
  client.upload_map(hills.view(map_id, 1)).value();
  {
    const nesam::Session planner = driven(client, "predictor", map_id);
    run("service_half_precision_is_rounding_only", [&] { service_half_precision_is_rounding_only(planner); });
    run("service_half_precision_of_what_the_service_draws", [&] { service_half_precision_of_what_the_service_draws(planner); });
    run("service_a_prediction_from_now_rolls_forward_with_what_was_sent",
        [&] { service_a_prediction_from_now_rolls_forward_with_what_was_sent(planner); });
    run("service_bad_instants_are_refused", [&] { service_bad_instants_are_refused(planner); });
    run("service_who_is_overloaded_is_told_when_to_come_back", [&] { service_who_is_overloaded_is_told_when_to_come_back(planner); });
  }
  client.delete_map(map_id).value();
}

}  // namespace

int main(int argc, char** argv) { return run_against_server(argc, argv, run_all); }
