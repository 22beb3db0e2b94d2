// Goal: a fallback begins at the newest state of its session, also where an answer comes late or not at all, at none that is old or of another session of the same
// name, and answers nothing that the service refuses.
// Method: questions and measurements, numbered as they are sent and heard in another order, times of the test; one wrong thing in a request at a time.
//
// Usage: known_states_test     Exit codes: check.hpp.

#include "../src/known_states.hpp"

#include <chrono>
#include <cstdint>
#include <cstdio>
#include <limits>
#include <optional>
#include <utility>
#include <vector>

#include "../src/fallback_prediction.hpp"
#include "check.hpp"

namespace {

using nesam::detail::Moment;
using namespace std::chrono_literals;

/// What is known of the session "s", told by stamps.
struct Known : nesam::detail::KnownStates {
  /// Where a fallback begins that is asked plainly.
  std::optional<std::int64_t> newest(Time now = std::chrono::steady_clock::now()) const {
    const nesam::detail::Known known = of("s", now);
    return known.measured ? stamp(known.measured) : stamp(known.ahead);
  }

  /// The measurement, and where a prediction began that was rolled forward.
  std::pair<std::optional<std::int64_t>, std::optional<std::int64_t>> both() const {
    const nesam::detail::Known known = of("s");
    return {stamp(known.measured), stamp(known.ahead)};
  }

  static std::optional<std::int64_t> stamp(const std::optional<nesam::detail::KnownState>& known) { return known ? known->stamp_ns : std::nullopt; }

  static nesam::Measurement measurement(std::int64_t stamp_ns) {
    nesam::Measurement measurement;
    measurement.stamp_ns = stamp_ns;
    return measurement;
  }

  std::optional<std::int64_t> hear(const Moment& sent, std::int64_t stamp_ns, decltype(nesam::MeasurementAnswer::outcome) outcome) {
    nesam::MeasurementAnswer answer;
    answer.outcome = std::move(outcome);
    measured(sent, "s", measurement(stamp_ns), answer);
    return newest();
  }

  std::optional<std::int64_t> lose(const Moment& sent, std::int64_t stamp_ns) {
    unheard(sent, "s", measurement(stamp_ns));
    return newest();
  }

  /// A prediction that began there.
  std::optional<std::int64_t> begins(const Moment& asked, std::int64_t stamp_ns, double age_s = 0.0) {
    nesam::Prediction prediction;
    prediction.start_stamp_ns = stamp_ns;
    prediction.measurement_age_s = age_s;
    predicted(asked, "s", nesam::PredictRequest{}, prediction);
    return newest();
  }

  /// The answer to a question from an instant, which began so many steps after a measurement.
  std::pair<std::optional<std::int64_t>, std::optional<std::int64_t>> rolls(const Moment& asked, std::int64_t stamp_ns, std::uint32_t steps) {
    nesam::Prediction prediction;
    prediction.start_stamp_ns = stamp_ns;
    prediction.rolled_forward_steps = steps;
    nesam::PredictRequest request;
    request.start_stamp_ns = stamp_ns;
    predicted(asked, "s", request, prediction);
    return both();
  }
};

using Stamps = std::pair<std::optional<std::int64_t>, std::optional<std::int64_t>>;

void analytic_what_was_asked_for_earlier_replaces_only_what_is_older() {
  Known known;
  const Moment late = known.ask(), ahead = known.ask();
  check(known.hear(known.ask(), 200, nesam::Applied{}) == 200, "a measurement");
  check(known.begins(late, 100) == 200, "it was asked for before the measurement and is older");
  check(known.begins(ahead, 300) == 300, "somebody else had measured more");
  check(known.hear(known.ask(), 250, nesam::Applied{}) == 250, "what was sent later tells what the session has now");
  const Moment of_the_old_clock = known.ask(), jump = known.ask(), after = known.ask();
  check(known.begins(after, 260) == 260, "another prediction");
  check(known.hear(jump, 10, nesam::ClockJump{}) == 10, "stamps of before say nothing");
  check(known.begins(of_the_old_clock, 400) == 10, "the clock has begun anew since");
  check(known.hear(known.ask(), 20, nesam::Applied{}) == 20, "the new clock goes on");
  check(known.hear(known.ask(), 5, nesam::Restarted{}) == 5, "the vehicle has been restarted");
  check(known.begins(after, 500) == 5, "since it was asked for");
  check(known.begins(known.ask(), 7) == 7, "what is asked for now");
}

void analytic_a_measurement_counts_whatever_became_of_it_unless_it_is_refused() {
  Known known;
  const auto rejected = [](nesam::Code code) { return nesam::Rejected{code, "", ""}; };
  check(known.hear(known.ask(), 10, nesam::Applied{}) == 10, "a measurement");
  check(known.hear(known.ask(), 11, nesam::Buffered{}) == 11, "it waits for the grid, the vehicle is there");
  check(known.begins(known.ask(), 10) == 11, "the step before it is older");
  check(known.begins(known.ask(), 20) == 20, "a later one");
  check(known.lose(known.ask(), 30) == 30, "it got no answer");
  check(known.hear(known.ask(), 40, rejected(nesam::Code::resource_exhausted)) == 40, "there was no room");
  check(known.hear(known.ask(), 50, nesam::TooOld{}) == 40 && known.hear(known.ask(), 50, nesam::Duplicate{}) == 40, "refused");
  check(known.hear(known.ask(), 50, rejected(nesam::Code::invalid_argument)) == 40, "refused for good");
  nesam::Measurement nowhere = Known::measurement(60);
  nowhere.state.position_m[1] = std::numeric_limits<double>::quiet_NaN();
  known.unheard(known.ask(), "s", nowhere);
  check(known.newest() == 40, "it is nowhere");
  check(known.lose(known.ask(), 35) == 40, "kept since before, sent again");
}

void analytic_a_state_grows_too_old() {
  Known known;
  const auto now = std::chrono::steady_clock::now();
  const auto at = [&](std::chrono::milliseconds after) { return Moment{known.ask().number, now + after}; };
  const auto after = [&](std::chrono::milliseconds later) { return known.newest(now + later); };
  known.hear(at(0ms), 10, nesam::Applied{});
  check(after(3200ms) == 10 && !after(3201ms), "at its limit and beyond");
  known.lose(at(4000ms), 10);
  check(!after(4000ms), "the same one sent again");
  known.begins(at(6000ms), 20, 3.0);
  check(after(6200ms) == 20 && !after(6201ms), "as old as a prediction says");
  for (const double age_s : {std::numeric_limits<double>::quiet_NaN(), -1.0, 1e300}) known.begins(at(6000ms), 30, age_s);
  check(after(6200ms) == 20, "an age that is none");
  known.lose(at(7000ms), 90);
  known.hear(at(10200ms), 60, nesam::Applied{});
  check(after(7000ms) == 90, "it is no step yet, and stays");
  known.hear(at(10201ms), 60, nesam::Applied{});
  check(after(10201ms) == 60, "no longer than that");
}

void analytic_a_session_of_the_same_name_is_another_one() {
  Known known;
  check(known.hear(known.ask(), 10, nesam::Applied{}) == 10, "a measurement");
  const Moment sent = known.ask(), asked = known.ask();
  known.opened("s");
  check(!known.newest(), "nothing is known of the new one");
  check(!known.hear(sent, 20, nesam::Applied{}) && !known.begins(asked, 30) && !known.lose(sent, 20), "they are of the session before");
  check(known.hear(known.ask(), 1, nesam::Applied{}) == 1, "of the new one");
  known.refused("s", nesam::Error(nesam::Code::permission_denied, "session_id", ""));
  check(known.newest() == 1, "another refusal");
  known.refused("s", nesam::Error(nesam::Code::not_found, "session_id", ""));
  check(!known.newest(), "the service has lost it");
  known.hear(known.ask(), 2, nesam::Applied{});
  check(!known.hear(known.ask(), 3, nesam::Rejected{nesam::Code::not_found, "session_id", ""}), "and says so to a measurement");
}

void regress_a_state_that_was_rolled_forward_is_kept_apart() {
  Known known;
  known.hear(known.ask(), 100, nesam::Applied{});
  const Moment late = known.ask();
  check(known.rolls(known.ask(), 900, 8) == Stamps(100, 900) && known.newest() == 100, "no measurement");
  check(known.rolls(known.ask(), 300, 2) == Stamps(100, 300), "the last one");
  check(known.rolls(late, 600, 5) == Stamps(100, 300), "it was asked for before");
  known.hear(known.ask(), 200, nesam::Applied{});
  check(known.rolls(known.ask(), 100, 0) == Stamps(200, 300), "measurements overtook the question");
  check(known.rolls(known.ask(), 250, 0) == Stamps(250, 300), "somebody else has measured more");
  const Moment of_the_old_clock = known.ask();
  known.hear(known.ask(), 5, nesam::ClockJump{});
  check(known.both() == Stamps(5, std::nullopt), "the clock has begun anew");
  check(known.rolls(of_the_old_clock, 400, 3) == Stamps(5, std::nullopt), "of the clock before");
  known.opened("s");
  check(known.rolls(known.ask(), 400, 3) == Stamps(std::nullopt, 400) && known.newest() == 400, "nothing was measured here");
  known.forget("s");
  check(known.both() == Stamps(std::nullopt, std::nullopt), "closed");
}

/// A measurement at 1 s and a state that the service rolled forward from it to 1.8 s: instants before and after that, and none; then a newer measurement, and none.
void regress_a_fallback_begins_no_later_than_it_is_asked_to() {
  const std::vector<float> commands = {0.5F, 0.0F};
  nesam::PredictRequest asked;
  asked.controls = {nesam::Span<const float>(commands), 1, 1, 2};
  asked.fallback.emplace();
  asked.fallback->vehicle.speed_max_m_s = asked.fallback->vehicle.second_max = 1.0;
  asked.fallback->vehicle.second = nesam::SecondCommand::yaw_rate_rad_s;
  const nesam::Error late(nesam::Code::deadline_exceeded, "", "late");
  const auto state = [](double z_m, std::int64_t stamp_ns, std::uint32_t steps) {
    nesam::detail::KnownState known{{}, stamp_ns, steps};
    known.state.position_m[2] = z_m;
    return known;
  };
  struct Begin {
    std::int64_t stamp_ns;
    std::uint32_t steps;
    double z_m;
  };
  constexpr std::int64_t tenth_ns = 100'000'000;
  const auto begins = [&](const nesam::detail::Known& known, std::optional<std::int64_t> tenths, std::optional<Begin> expected, const char* what) {
    asked.start_stamp_ns = tenths ? std::optional(*tenths * tenth_ns) : std::nullopt;
    const auto answered = nesam::detail::fallback_prediction(asked, known, late);
    check(answered.has_value() == expected.has_value(), what);
    if (!answered || !expected) return;
    check(answered->start_stamp_ns == expected->stamp_ns * tenth_ns && answered->rolled_forward_steps == expected->steps, what);
    check(answered->start.position_m[2] == expected->z_m, what);
  };
  const auto ahead = state(7.0, 18 * tenth_ns, 8);
  const nesam::detail::Known both{state(3.0, 10 * tenth_ns, 0), ahead};
  begins(both, std::nullopt, Begin{10, 0, 3.0}, "what was measured");
  begins(both, 11, Begin{11, 1, 3.0}, "not later than was asked");
  begins(both, 18, Begin{18, 8, 7.0}, "as the service rolled it");
  begins(both, 19, Begin{19, 9, 7.0}, "steps count from the measurement");
  begins(both, 42, Begin{42, 32, 7.0}, "as far as the service");
  begins(both, 43, std::nullopt, "no further");
  begins({state(3.0, 11 * tenth_ns, 0), ahead}, 19, Begin{19, 8, 3.0}, "a newer measurement");
  const nesam::detail::Known alone{std::nullopt, ahead};
  begins(alone, std::nullopt, Begin{18, 8, 7.0}, "nothing else is known");
  begins(alone, 19, Begin{19, 9, 7.0}, "nothing else is known from then");
  begins(alone, 11, std::nullopt, "nothing is known of before");
}

/// What the service refuses, here and in the other clients: test_client.py holds these against the service.
void regress_a_fallback_answers_nothing_that_the_service_refuses() {
  const std::vector<float> commands(2 * 3 * 40, 0.5F), path = {0.0F, 0.0F, 9.0F, 0.0F}, broken = {0.0F, 0.0F, std::nanf(""), 0.0F};
  const nesam::Span<const float> numbers(commands);
  const nesam::SentCommand sent[] = {{0, {0.5, 0.0}}};
  nesam::PredictRequest sound;
  sound.controls = {numbers.subspan(0, 2 * 3 * 4), 3, 4, 2};
  sound.fallback.emplace();
  sound.fallback->vehicle.speed_max_m_s = sound.fallback->vehicle.second_max = 1.0;
  sound.fallback->vehicle.second = nesam::SecondCommand::yaw_rate_rad_s;
  const nesam::detail::Known known{nesam::detail::KnownState{{}, 0}, std::nullopt};
  const nesam::Error late(nesam::Code::deadline_exceeded, "", "late");
  const auto answers = [&](const nesam::PredictRequest& request) { return nesam::detail::fallback_prediction(request, known, late).has_value(); };
  check(answers(sound), "nothing is wrong");
  const auto refused = [&](const char* what, auto change) {
    nesam::PredictRequest request = sound;
    change(request);
    check(!answers(request), what);
  };
  const nesam::CandidateDrawing drawing{4, numbers.subspan(0, 8), 0.1, 0.1, 0.5, 1};
  const auto drawn = [&](nesam::PredictRequest& request) -> nesam::CandidateDrawing& {
    request.controls = {};
    return request.drawing.emplace(drawing);
  };
  const auto ranked = [&](nesam::PredictRequest& request) -> nesam::PathCost& {
    request.cost.emplace().path_m = path;
    return *request.cost;
  };
  nesam::PredictRequest whole = sound;
  drawn(whole);
  ranked(whole).best = 4;
  check(answers(whole), "nor with a drawing and a cost");
  refused("more steps than the model has", [&](auto& request) { request.controls = {numbers.subspan(0, 2 * 3 * 33), 3, 33, 2}; });
  refused("a stride beyond the horizon", [](auto& request) { request.stride = 5; });
  refused("more than all", [](auto& request) { request.samples_min = 4; });
  refused("far away", [](auto& request) { request.start.emplace().position_m[1] = 1e9; });
  refused("from a state and an instant", [](auto& request) { request.start.emplace(), request.start_stamp_ns = 0; });
  refused("sent before no instant", [&](auto& request) { request.sent = sent; });
  refused("no sample drawn", [&](auto& request) { drawn(request).samples = 0; });
  refused("a negative deviation", [&](auto& request) { drawn(request).second_sd = -0.1; });
  refused("noise that stays", [&](auto& request) { drawn(request).correlation = 1.0; });
  refused("a path of one point", [&](auto& request) { ranked(request).path_m = nesam::Span<const float>(path).subspan(0, 2); });
  refused("a path that is none", [&](auto& request) { ranked(request).path_m = broken; });
  refused("a negative weight", [&](auto& request) { ranked(request).tilt_weight = -1.0; });
  refused("more of the best than there are", [&](auto& request) { ranked(request).best = 4; });
  refused("a cost and extras", [&](auto& request) { ranked(request), request.extras.risk = true; });

  // A link that stalls: the newest measurement that the service has is too old for where the candidates begin.
  nesam::PredictRequest from_now = sound;
  from_now.start_stamp_ns = 300'000'000;
  const auto stalled = nesam::detail::fallback_prediction(from_now, known, nesam::Error(nesam::Code::failed_precondition, "start_stamp_ns", "too old"));
  check(stalled && stalled->rolled_forward_steps == 3, "who knows nothing new is as good as late");
  check(!nesam::detail::fallback_prediction(from_now, known, nesam::Error(nesam::Code::failed_precondition, "", "no measurement")), "no measurement at all");
}

}  // namespace

int main() {
  run("analytic_what_was_asked_for_earlier_replaces_only_what_is_older", analytic_what_was_asked_for_earlier_replaces_only_what_is_older);
  run("analytic_a_measurement_counts_whatever_became_of_it_unless_it_is_refused", analytic_a_measurement_counts_whatever_became_of_it_unless_it_is_refused);
  run("analytic_a_state_grows_too_old", analytic_a_state_grows_too_old);
  run("analytic_a_session_of_the_same_name_is_another_one", analytic_a_session_of_the_same_name_is_another_one);
  run("regress_a_state_that_was_rolled_forward_is_kept_apart", regress_a_state_that_was_rolled_forward_is_kept_apart);
  run("regress_a_fallback_begins_no_later_than_it_is_asked_to", regress_a_fallback_begins_no_later_than_it_is_asked_to);
  run("regress_a_fallback_answers_nothing_that_the_service_refuses", regress_a_fallback_answers_nothing_that_the_service_refuses);
  std::printf("%d passed, %d failed\n", passed, failed);
  return failed == 0 ? 0 : 1;
}
