// Goal: streams answer as single calls do, in order, say what ends them, and keep their limits.
// Method: two threads on one stream, bad input in the middle, nobody who collects, a session that closes under it. Predictions of a stream must have the bits
// of single calls; estimates of the soil must tell every update that the answers to the measurements tell.
//
// Usage and exit codes: check.hpp.

#include <nesam/nesam.hpp>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <optional>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "check.hpp"
#include "scenario.hpp"

namespace {

using namespace std::chrono_literals;

void service_streams_of_measurements(nesam::Client& client) {
  nesam::OpenOptions options;
  options.vehicle_id = unique("streamer");
  auto session = client.open(options);
  check(session.ok(), session.ok() ? "" : session.error().what());
  if (!session) return;
  auto stream = session->measurements();
  check(stream.ok(), "stream");
  if (!stream) return;
  check_error(stream->receive(20ms), nesam::Code::deadline_exceeded, "", "nothing sent yet");
  // One thread sends, this one collects.
  constexpr int count = 300;
  const nesam::VehicleCard card = session->vehicle();
  bool all_sent = true;
  std::thread sender([&] {
    for (int step = 0; step < count; ++step) all_sent = stream->send(cruise(step, card)).ok() && all_sent;
  });
  int in_order = 0;
  for (int step = 0; step < count; ++step) {
    const auto answer = stream->receive(10s);
    in_order += answer.ok() && answer->accepted() && answer->sequence == static_cast<std::uint64_t>(step) + 1 ? 1 : 0;
  }
  sender.join();
  check(all_sent && in_order == count && stream->unanswered().empty(), std::to_string(in_order) + " of 300 answers in order");

  nesam::Measurement late = cruise(count + 20, card);
  check(stream->send(late).ok(), "after a pause");
  const auto gap = stream->receive(10s);
  check(gap.ok() && gap->is<nesam::Gap>() && std::abs(gap->is<nesam::Gap>()->gap_s - 2.1) < 1e-6, "GAP");
  // Nobody collects: the limit holds, and the answers are still there afterwards.
  std::size_t queued = 0;
  while (queued <= nesam::MeasurementStream::pending_max && stream->send(late).ok()) ++queued;
  check(queued == nesam::MeasurementStream::pending_max, "limit of uncollected answers");
  check_error(stream->send(late), nesam::Code::resource_exhausted, "", "beyond the limit");
  check(stream->finish(10s).ok(), "finish");
  std::size_t duplicates = 0;
  while (true) {
    const auto answer = stream->receive(1s);
    if (!answer) {
      check_error(answer, nesam::Code::failed_precondition, "", "all answers were collected");
      break;
    }
    duplicates += answer->is<nesam::Duplicate>() ? 1 : 0;
  }
  check(duplicates == queued, "every measurement was answered before the end");
  check_error(stream->send(late), nesam::Code::failed_precondition, "", "sending after the end");

  // A stream outlives its session on the server: measurements are refused one by one.
  auto orphan = session->measurements();
  check(orphan.ok() && session->close().ok(), "close under a stream");
  check(orphan->send(late).ok(), "queued");
  const auto refused = orphan->receive(10s);
  const auto* rejected = refused.ok() ? refused->is<nesam::Rejected>() : nullptr;
  check(rejected && rejected->code == nesam::Code::not_found && rejected->field == "session_id", "REJECTED with NOT_FOUND");
}

/// One thread sends, this one collects; everything again while the service is overloaded.
std::vector<nesam::PredictionAnswer> exchanged(nesam::PredictionStream& stream, const std::vector<nesam::PredictRequest>& requests) {
  const auto overloaded = [](const nesam::PredictionAnswer& answer) {
    return !answer.prediction && answer.prediction.error().code() == nesam::Code::resource_exhausted;
  };
  std::vector<nesam::PredictionAnswer> answers;
  for (int attempt = 0; attempt < 5; ++attempt) {
    answers.clear();
    std::thread sender([&] {
      for (const nesam::PredictRequest& request : requests) (void)stream.send(request);
    });
    while (answers.size() < requests.size()) {
      auto answer = stream.receive(60s);
      if (!check_ok(answer, "answer")) break;
      answers.push_back(std::move(*answer));
    }
    sender.join();
    if (std::none_of(answers.begin(), answers.end(), overloaded)) break;
  }
  check(answers.size() == requests.size(), "an answer to each request");
  return answers;
}

void service_a_stream_predicts_as_single_calls_do(const nesam::Session& session) {
  constexpr std::size_t samples = 5, horizon = 12;
  const auto controls = varied_controls(samples, horizon, session.vehicle());
  auto stream = session.predictions();
  if (!check_ok(stream, "stream")) return;
  // Good ones, each of another kind, and bad ones between them.
  std::vector<nesam::PredictRequest> requests(6, request_of(controls, samples, horizon));
  requests[1].controls = {nesam::Span<const float>(controls).subspan(0, 4 * horizon), 2, horizon, 2};
  requests[1].wheel_sinkage = true;
  requests[1].extras.jacobians = true;
  requests[2].stride = horizon + 1;
  requests[3].extras.soil_sigma_points = true;
  requests[3].extras.risk = true;
  requests[4].extras.exact_terrain = true;
  requests[4].extras.interpolation_deviation = true;
  requests[5].controls = {};
  requests[5].drawing = nesam::CandidateDrawing{7, nesam::Span<const float>(controls).subspan(0, 2 * horizon), 0.5, 0.1, 0.0, 3};
  for (std::size_t i = 0; i < requests.size(); ++i) requests[i].tag = 100 + i;
  const auto answers = exchanged(*stream, requests);
  for (std::size_t i = 0; i < answers.size(); ++i) {
    const auto& streamed = answers[i].prediction;
    const auto single = predicted(session, requests[i]);
    const std::string what = "request " + std::to_string(i);
    check(answers[i].tag == 100 + i && streamed.ok() == single.ok(), what + " in order");
    if (!single.ok() && !streamed.ok()) check_error(streamed, single.error().code(), single.error().field(), what);
    if (!single.ok() || !streamed.ok()) continue;
    check(streamed->tag == 100 + i && equal_bits(streamed->states().values(), single->states().values()), what + " has the bits of the single call");
    check(streamed->rows() == single->rows() && streamed->validity == single->validity, what + ": rows and validity");
  }
  if (answers.size() != requests.size()) return;
  check_error(answers[2].prediction, nesam::Code::invalid_argument, "output.stride", "a stride beyond the horizon");
  check_error(answers[4].prediction, nesam::Code::invalid_argument, "extras.interpolation_deviation", "exact and interpolated");
  const nesam::Prediction &derived = answers[1].prediction.value(), &sigma = answers[3].prediction.value();
  const nesam::ExtraOutputs expected = predicted(session, requests[1]).value().extras;
  check(equal_bits(derived.extras.jacobian_controls.values(), expected.jacobian_controls.values()), "so have Jacobians");
  check(derived.sinkage_m().fits() && sigma.extras.traction_reserve.shape()[0] == 13 * samples, "sinkage and risk");
}

void service_a_prediction_stream_has_limits_and_ends(nesam::Session& session) {
  constexpr std::size_t horizon = 12;
  const auto controls = varied_controls(1, horizon, session.vehicle());
  const nesam::PredictRequest one = request_of(controls, 1, horizon);
  auto stream = session.predictions();
  if (!check_ok(stream, "stream")) return;
  // A request that contradicts itself is not sent.
  check_error(stream->send(request_of(controls, 1, horizon + 1)), nesam::Code::invalid_argument, "controls", "controls that do not fit their shape");
  check_error(stream->receive(20ms), nesam::Code::deadline_exceeded, "", "nothing was asked");
  // Nobody collects: the limit holds, and the answers are still there afterwards.
  std::size_t queued = 0;
  while (queued <= nesam::PredictionStream::pending_max && stream->send(one).ok()) ++queued;
  check(queued == nesam::PredictionStream::pending_max, "limit of uncollected answers");
  check_error(stream->send(one), nesam::Code::resource_exhausted, "", "beyond the limit");
  check_ok(stream->finish(60s), "finish");
  std::size_t collected = 0;
  while (true) {
    const auto answer = stream->receive(1s);
    if (!answer) {
      check_error(answer, nesam::Code::failed_precondition, "", "all answers were collected");
      break;
    }
    ++collected;
  }
  check(collected == queued, "every request was answered before the end");
  check_error(stream->send(one), nesam::Code::failed_precondition, "", "asking after the end");

  // A stream outlives its session on the server; one that nobody finishes is cancelled.
  auto orphan = session.predictions();
  check(orphan.ok() && session.close().ok(), "close under a stream");
  check(orphan->send(one).ok(), "queued");
  const auto refused = orphan->receive(60s);
  if (check_ok(refused, "an answer")) check_error(refused->prediction, nesam::Code::not_found, "session_id", "a closed session");
  check(orphan->send(one).ok(), "left unanswered");
}

void service_the_soil_is_watched(nesam::Session& session) {
  nesam::SoilWatch watch = session.watch_soil();
  const auto first = watch.receive(30s);
  if (!check_ok(first, "the present estimate")) return;
  check(first->session_id == session.id() && first->soil_epoch == 0 && !first->stamp_ns, "nothing learned yet");
  check(first->correction.coordinates != nesam::SoilCoordinates::unspecified && first->correction.delta.n == 0.0, "no correction yet");
  check_error(watch.receive(20ms), nesam::Code::deadline_exceeded, "", "no change");

  std::uint64_t epoch = 0;
  for (const nesam::Measurement& measurement : predicted_drive(session)) {
    const auto answer = session.send(measurement);
    if (!check_ok(answer, "measurement")) return;
    if (answer->soil_epoch == epoch) continue;
    epoch = answer->soil_epoch;
    const auto told = watch.receive(30s);
    if (!check_ok(told, "an update")) return;
    check(told->soil_epoch == epoch && told->stamp_ns && *told->stamp_ns <= measurement.stamp_ns, "update " + std::to_string(epoch) + " is told");
    check(told->history_epoch == answer->history_epoch && told->map_version == answer->map_version && told->map_version > 0, "where the session stands");
    check(told->bundle_hash == answer->bundle_hash && told->bundle_hash.size() == 64, "the bundle");
    const auto status = session.status();
    check(status.ok() && status->soil_correction.delta.k_phi == told->correction.delta.k_phi, "the session has learned the same");
    const auto& covariance = told->correction.covariance;
    check(covariance && told->correction.variance && (*covariance)[3][3] == told->correction.variance->c_pa, "the variance is the diagonal");
  }
  check(epoch > 0, "the drive has told something of the soil");
  check_error(watch.receive(20ms), nesam::Code::deadline_exceeded, "", "every update was told once");

  // A second watch begins with what holds; one that nobody waits for goes in peace; both end with the session.
  nesam::SoilWatch late = session.watch_soil();
  const nesam::SoilWatch idle = session.watch_soil();
  const auto present = late.receive(30s);
  check(present.ok() && present->soil_epoch == epoch, "what holds comes first");
  check_ok(session.close(), "close");
  check_error(late.receive(30s), nesam::Code::not_found, "session_id", "the session was closed");
  check_error(late.receive(0s), nesam::Code::not_found, "session_id", "and stays closed");
  check_error(watch.receive(30s), nesam::Code::not_found, "session_id", "the first watch ends too");
  late = session.watch_soil();
  check_error(late.receive(30s), nesam::Code::not_found, "session_id", "an unknown session");
}

void run_all(nesam::Client& client) {
  run("service_streams_of_measurements", [&] { service_streams_of_measurements(client); });
  const HillyMap hills;
  const std::string map_id = unique("hills");
  client.upload_map(hills.view(map_id, 1)).value();
  {
    nesam::Session planner = driven(client, "planner", map_id);
    run("service_a_stream_predicts_as_single_calls_do", [&] { service_a_stream_predicts_as_single_calls_do(planner); });
    run("service_a_prediction_stream_has_limits_and_ends", [&] { service_a_prediction_stream_has_limits_and_ends(planner); });
    nesam::Session watched = driven(client, "watched", map_id);
    run("service_the_soil_is_watched", [&] { service_the_soil_is_watched(watched); });
  }
  client.delete_map(map_id).value();
}

}  // namespace

int main(int argc, char** argv) { return run_against_server(argc, argv, run_all); }
