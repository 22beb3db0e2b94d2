// Goal: a fallback begins at the newest state of its session, also where an answer comes late.
// Method: questions and measurements, numbered as they are sent and heard in another order.
//
// Usage: known_states_test     Exit codes: check.hpp.

#include "../src/known_states.hpp"

#include <cstdint>
#include <cstdio>
#include <optional>
#include <utility>

#include "check.hpp"

namespace {

void analytic_what_was_asked_for_earlier_replaces_only_what_is_older() {
  nesam::detail::KnownStates known;
  const auto newest = [&known] { return known.of("s") ? known.of("s")->stamp_ns : std::nullopt; };
  const auto measured = [&](std::uint64_t asked, std::int64_t stamp_ns, decltype(nesam::MeasurementAnswer::outcome) outcome) {
    nesam::Measurement measurement;
    measurement.stamp_ns = stamp_ns;
    nesam::MeasurementAnswer answer;
    answer.session_id = "s";
    answer.outcome = std::move(outcome);
    known.measured(asked, measurement, answer);
    return newest();
  };
  const auto predicted = [&](std::uint64_t asked, std::int64_t stamp_ns) {
    nesam::Prediction prediction;
    prediction.start_stamp_ns = stamp_ns;
    known.predicted(asked, "s", nesam::PredictRequest{}, prediction);
    return newest();
  };
  const std::uint64_t late = known.ask(), ahead = known.ask();
  check(measured(known.ask(), 200, nesam::Applied{}) == 200, "a measurement");
  check(predicted(late, 100) == 200, "it was asked for before the measurement and is older");
  check(predicted(ahead, 300) == 300, "somebody else had measured more");
  check(measured(known.ask(), 250, nesam::Applied{}) == 250, "what was sent later tells what the session has now");
  const std::uint64_t of_the_old_clock = known.ask(), jump = known.ask(), after = known.ask();
  check(predicted(after, 260) == 260, "another prediction");
  check(measured(jump, 10, nesam::ClockJump{}) == 10, "stamps of before say nothing");
  check(predicted(of_the_old_clock, 400) == 10, "the clock has begun anew since");
  check(measured(known.ask(), 20, nesam::Applied{}) == 20, "the new clock goes on");
  check(measured(known.ask(), 5, nesam::Restarted{}) == 5, "the vehicle has been restarted");
  check(predicted(after, 500) == 5, "since it was asked for");
  check(predicted(known.ask(), 7) == 7, "what is asked for now");
}

}  // namespace

int main() {
  run("analytic_what_was_asked_for_earlier_replaces_only_what_is_older", analytic_what_was_asked_for_earlier_replaces_only_what_is_older);
  std::printf("%d passed, %d failed\n", passed, failed);
  return failed == 0 ? 0 : 1;
}
